"""The report of a camera alone in a real browser: the image shows where nothing was measured."""

from __future__ import annotations

import io
from collections.abc import Mapping
from contextlib import ExitStack
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from support.browser import Browser, browser_or_skip
from support.planes import merged_in_plane, moved_in_plane, one_region, plane, strain_in_plane

from sms_jobs.archive import Archive, FolderStore, Provenance
from sms_jobs.kinds.documents import DocumentOutput
from sms_jobs.kinds.kind import Inputs, Need
from sms_jobs.kinds.products import MERGED
from sms_jobs.kinds.reporting import report
from sms_jobs.kinds.reporting.report import ReportParameters
from sms_jobs.records.campaign import Campaign, LoadState, Specimen
from sms_jobs.records.measurement import ArrayStack, FringeSequence, Measurement
from sms_jobs.records.reasons import Reason
from sms_jobs.records.subject import Subject

WHEN = datetime(2026, 1, 2, tzinfo=UTC)
SHAPE = (60, 80)
EDGE = 20
"""Column where the specimen begins; left of it a checked background shows."""


def records_for(need: Need) -> Mapping[str, Any]:
    row, column = np.indices(SHAPE)
    if need.source == "measurement":
        checks = np.where((row // 10 + column // 10) % 2 == 0, 40, 200).astype(np.uint16)
        return {
            "measurement": Measurement(
                WHEN, FringeSequence(), 255, 0.03, 0.5, checks, ArrayStack(checks[None])
            )
        }
    reason = np.where(column < EDGE, np.uint32(Reason.NO_TEXTURE), np.uint32(0)).astype(np.uint32)
    surface = plane(reason)
    moved = moved_in_plane(surface, 1e-3 * column, 0.0 * column)
    return {
        "plane": {"surface": surface},
        "correlate": {"regions": one_region(surface)},
        "strain": {"strain": strain_in_plane(surface)},
        "merge": {MERGED.of("C1").stored_as: merged_in_plane(surface, moved)},
    }[need.source]


def written(folder: Path) -> Path:
    """Run the report on results in an archive, and return its page."""
    states = (LoadState("00"), LoadState("01", load_n=1500.0))
    campaign = Campaign("coupon", Specimen("coupon"), "camera", states, ("C1",))
    subject, archive = Subject("coupon"), Archive(FolderStore(folder / "archive"))
    with ExitStack() as stack:
        datasets = {}
        for place, need in enumerate(report.KIND.needs(campaign, subject, report.ReportParameters())):
            made = Provenance(
                need.source, 1, need.subject, f"{place:032x}", 1, WHEN, {}, (), "0.1", "here", "me"
            )
            sealed = archive.seal_dataset(records_for(need), made)
            datasets[need.role] = stack.enter_context(archive.open(sealed))
        inputs = Inputs(subject, report.KIND.context(campaign, subject), datasets)
        (output,) = report.KIND.run(inputs, ReportParameters(), lambda fraction, message="": None)
        assert isinstance(output, DocumentOutput)
        output.write(folder / output.filename)
    return folder / output.filename


def test_the_image_shows_where_nothing_was_measured(tmp_path: Path) -> None:
    page = written(tmp_path)
    which = "document.querySelector('#v2')"
    with Browser(browser_or_skip(), tmp_path / "profile") as browser:
        browser.open(page)
        browser.run(f"{which}.scrollIntoView()")
        browser.wait_for(f"{which}.querySelector('.readout').textContent.length > 9")
        address = browser.run(f"{which}.querySelector('canvas').toDataURL()")
        assert browser.complaints == []
    shown = np.asarray(Image.open(io.BytesIO(browser.decoded(address))).convert("RGB"), np.int16)
    scale = shown.shape[1] / SHAPE[1]

    def at(row: int, column: int) -> np.ndarray:
        return shown[int((row + 0.5) * scale), int((column + 0.5) * scale)]

    # The checks of the background are black and white greys, whose range is that of the image itself.
    assert (at(5, 5) == 0).all()
    assert (at(5, 15) == 255).all()
    # The specimen is in colours.
    assert np.ptp(at(30, 70)) > 50
