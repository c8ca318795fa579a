"""What is shown of kinds tells what they take and give, without running any."""

from __future__ import annotations

from sms_jobs.app.work.kinds import KindView, OutputView, PortView, TakenRecord, kinds
from sms_jobs.formats.exporters import all_exporters
from sms_jobs.kinds import all_kinds
from sms_jobs.kinds.surface_ports import MAKERS

SHOWN = {view.name: view for view in kinds()}
HTML = "text/html"


def port_of(kind: KindView, name: str) -> PortView:
    (found,) = (one for one in kind.inputs if one.name == name)
    return found


def test_what_is_shown_is_what_is_declared() -> None:
    for name, kind in all_kinds().items():
        view = SHOWN[name]
        pairs = {(port.name, source) for port in view.inputs for source in port.sources}
        assert pairs == {(port.name, port.source) for port in kind.inputs}
        read = {
            (port.name, record.name, source)
            for port in view.inputs
            for record in port.records
            for source in record.sources
        }
        assert read == {
            (port.name, product.name, port.source) for port in kind.inputs for product in port.products
        }
        assert len(view.outputs) == len(kind.outputs)


def test_a_port_that_several_makers_feed_is_shown_once() -> None:
    port = port_of(SHOWN["strain"], "reference")
    makers = tuple(maker.kind for maker in MAKERS)
    assert port == PortView("reference", makers, False, (TakenRecord("surface", "Surface", makers),))
    # What only some of them give is shown as that.
    phase = {record.name: record.sources for record in port_of(SHOWN["correlate"], "reference").records}
    assert (phase["surface"], phase["phase"]) == (makers, makers[:2])


def test_documents_are_shown_beside_records() -> None:
    assert SHOWN["report"].outputs == (OutputView("report", None, HTML, ""),)
    assert SHOWN["report-state"].outputs == SHOWN["report"].outputs
    assert {one.media_type for one in SHOWN["conditions"].outputs} == {"text/csv", "application/json"}
    assert OutputView("calibration", None, HTML, "") in SHOWN["calibrate-boards"].outputs
    written = {(one.name, one.media_type) for one in SHOWN["export"].outputs}
    assert written == {(one.name, one.media_type) for one in all_exporters().values()}


def test_what_a_result_has_several_of_says_what_tells_them_apart() -> None:
    keys = {kind: {one.name: one.key for one in SHOWN[kind].outputs if one.record} for kind in SHOWN}
    assert keys["merge"] == {"merged": "camera", "mesh": "camera"}
    assert keys["align"] == {"view": "number"}
    assert keys["mesh"] == {"mesh": ""}
    assert (keys["correlate"]["factor"], keys["reconstruct"]["factor"]) == ("state", "")
