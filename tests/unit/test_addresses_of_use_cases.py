"""Every use case has an address, or a reason why it has none."""

from __future__ import annotations

from importlib import import_module
from pkgutil import walk_packages
from typing import cast

from support.over_http import app_of

from sms_jobs import app
from sms_jobs.app.rules import rule_of
from sms_jobs.bootstrap import Services
from sms_jobs.web.routes import ROUTE_RULES

AT_THE_SERVER = "is about the machine itself, its processes, or a file on its disk"
PART = "is a part of what other addresses offer"
IN_A_PAGE = "is a step of logging in by pages"

WITHOUT_ADDRESS = {
    "archive.reindex": AT_THE_SERVER,
    "arrays.dataset_view": PART,  # GET /data/{key}
    "audit.export": AT_THE_SERVER,  # GET /audit tells the same
    "audit.head": AT_THE_SERVER,  # is kept where the server cannot change it
    "audit.verify": PART,  # POST /archive/verify
    "calibration_overview.candidate": PART,  # of the page on which a calibration is certified
    "calibrations.show": PART,  # GET /calibrations/{number}
    "campaigns.definition": PART,  # GET /campaigns/{name}
    "campaigns.names": PART,  # GET /campaigns
    "campaigns.overview": PART,  # GET /campaigns/{name}
    "database.back_up": AT_THE_SERVER,
    "database.copy": AT_THE_SERVER,
    "demo.run": AT_THE_SERVER,
    "experiments.exact": PART,  # of the demo
    "exporting.formats_of": PART,  # of the page of fields; GET /formats
    "field_sources.fields_of": PART,  # GET /data/{key}/fields
    "happenings.newest": PART,  # GET /events
    "image_entry.make_campaign": PART,  # POST /imports
    "boards.arrange_boards": PART,
    "frames.arrange_frames": PART,
    "images.arrange_images": PART,
    "readings.arrange_readings": PART,
    "outcomes.existing_campaign": PART,
    "jobs.choose": PART,  # of all that takes jobs
    "kernels.kernels_left": AT_THE_SERVER,
    "openid.begin": IN_A_PAGE,
    "openid.complete": IN_A_PAGE,
    "openid.is_offered": IN_A_PAGE,
    "openid.set_identity": AT_THE_SERVER,  # who may come in as whom
    "packing.pack": AT_THE_SERVER,  # to a disk that is carried away
    "packing.unpack": AT_THE_SERVER,
    "people.actor_of": PART,  # of every request
    "people.has_people": PART,
    "people.confirmed": PART,
    "reading.newest": PART,  # GET /data/newest, then its arrays
    "reading.of_file": PART,  # GET /data/{key}/record
    "recordings.wait_for_recordings": PART,  # GET /jobs/wait
    "rigs.lend": AT_THE_SERVER,
    "rigs.simulation": AT_THE_SERVER,
    "service.served": AT_THE_SERVER,
    "service.supervisor": AT_THE_SERVER,
    "streams.wait_for_stream": PART,  # GET /jobs/wait
    "system_tests.write": AT_THE_SERVER,  # POST /calibrations/tests/judge has the numbers
    "textures.measured_image": PART,  # of advice
    "uploads.opened": PART,  # of what is uploaded
}


def test_every_use_case_has_an_address_or_a_reason() -> None:
    app_of(cast(Services, None))
    offered = {rule.name for rule in ROUTE_RULES.values()}
    there = {
        rule.name
        for found in walk_packages(app.__path__, f"{app.__name__}.")
        for one in vars(import_module(found.name)).values()
        if callable(one) and one.__module__ == found.name and (rule := rule_of(one)) is not None
    }
    assert len(there) > 100
    # Neither one more nor one less: a reason is taken away when an address comes.
    assert there - offered == set(WITHOUT_ADDRESS)
