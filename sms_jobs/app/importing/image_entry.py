"""Images read, checked and entered one by one: what imports of specimens and of boards have in common."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING

from sms_jobs.app.importing.copies import remarks_on_copies
from sms_jobs.app.importing.outcomes import Outcome, TupleOutcome, outcome_of
from sms_jobs.app.progress import Step, Tell
from sms_jobs.app.rules import use_case
from sms_jobs.bootstrap import Services
from sms_jobs.errors import Conflict, InvalidInput
from sms_jobs.formats.importers.folders import Listing, NamePattern
from sms_jobs.formats.importers.frames import Arrangement, is_image
from sms_jobs.formats.importers.image_files import RawFormat
from sms_jobs.formats.importers.image_names import guess_image_pattern
from sms_jobs.formats.importers.image_sets import (
    ImageCamera,
    arrange_images,
    image_hash,
    image_measurement,
    of_one_size,
)
from sms_jobs.formats.importers.inspection import Inspected, full_scales_of, inspect, usual_noise
from sms_jobs.jobs.archiving.importing import (
    amend_campaign,
    existing_measurement,
    import_measurement,
    imported_files,
)
from sms_jobs.jobs.archiving.registration import register_campaign
from sms_jobs.records.people import Right
from sms_jobs.records.sizes import number_of
from sms_jobs.records.subject import Subject

if TYPE_CHECKING:
    from sms_jobs.records.campaign import Campaign

_GLINTS = 0.01
"""Part of an image that may saturate without a remark."""


@dataclass(frozen=True)
class CameraSettings:
    """What is said of the camera."""

    raw: RawFormat | None = None
    full_scale: int | None = None
    gain: float | None = None
    read_noise: float | None = None

    def reading_options(self) -> dict[str, float | None]:
        """Return what an image is read with besides its file."""
        return {"full_scale": self.full_scale, "gain": self.gain, "read_noise": self.read_noise}


def arranged(
    listing: Listing, pattern: str | None, camera: str | None, reference: str | None, named: Mapping[str, str]
) -> tuple[str, Arrangement]:
    """Return the pattern of the names, guessed where it is not given, and what each image is by it.

    Raises `InvalidInput` for a folder without images, and for a pattern that fits none.
    """
    names = [name for name in listing.files if is_image(name)]
    if not names:
        raise InvalidInput(
            f"{listing.folder} has no image among {number_of(len(listing.files), 'file')}: "
            "give the folder of the images"
        )
    text = pattern or guess_image_pattern(names, named)
    found = arrange_images(listing, NamePattern.parse(text, named), camera, reference, named)
    if not found.tuples:
        raise InvalidInput(f"no file of {listing.folder} fits the pattern '{text}': give another `pattern`")
    return text, found


def inspect_images(
    listing: Listing, arrangement: Arrangement, camera: CameraSettings, tell: Tell
) -> list[Inspected]:
    """Read every file once, before anything is written; `tell` counts files."""
    counted = Counted(tell, "reading", len(arrangement.tuples))
    return of_one_size(
        [
            inspect(listing.folder, one, camera.raw, camera.full_scale, counted.one_more)
            for one in arrangement.tuples
        ]
    )


class Counted:
    """Tells how many of some things are done."""

    def __init__(self, tell: Tell, doing: str, total: int) -> None:
        self._tell, self._doing, self._total, self._done = tell, doing, total, 0

    def one_more(self) -> None:
        """Tell that one more is done."""
        self._done += 1
        self._tell(Step(self._doing, self._done, self._total))


@use_case(Right.COMPUTE)
def make_campaign(services: Services, existing: Campaign | None, definition: Campaign) -> None:
    """Register a campaign that is not there yet, or give it what it does not have."""
    now = datetime.now(UTC)
    if existing is None:
        register_campaign(services.catalogue, services.archive, definition, None, now)
    elif definition != existing:
        amend_campaign(services.catalogue, services.archive, existing, definition, now)


def remarks_on_textures(good: Sequence[Inspected], scales: Sequence[int]) -> list[str]:
    """Return remarks on images in which there is nothing to match, each with its full scale."""
    return _blank(good) + _saturated(good, scales)


def _blank(good: Sequence[Inspected]) -> list[str]:
    """Return a remark on images that show nothing; none where there is no such image."""
    every = {name: about for one in good for name, about in one.facts.items()}
    blank = {name: about.highest for name, about in every.items() if about.at_highest == 1.0}
    if not blank:
        return []
    name, level = next(iter(blank.items()))
    verb = "is" if len(blank) == 1 else "are"
    remark = (
        f"{len(blank)} of {len(every)} images {verb} blank: every pixel of {name} is {level}, and nothing "
        "can be matched"
    )
    return [remark]


def _saturated(good: Sequence[Inspected], scales: Sequence[int]) -> list[str]:
    """Return a remark on images of which more saturates than glints do; none where there is no such image."""
    every = {
        n: (about, level) for one, level in zip(good, scales, strict=True) for n, about in one.facts.items()
    }
    many = {
        name: about.at_highest
        for name, (about, level) in every.items()
        if about.highest >= level and about.at_highest > _GLINTS
    }
    if not many:
        return []
    worst = max(many, key=many.__getitem__)
    remark = (
        f"{len(many)} of {len(every)} images saturate: {many[worst]:.0%} of {worst} is at grey level "
        f"{every[worst][1]}, where no texture is left to match; expose for less time if they can be "
        "recorded again"
    )
    return [remark]


@dataclass(frozen=True)
class EntryOptions:
    """How images are entered.

    Attributes
    ----------
    recorded_at
        When they were recorded; the files' times if it is None.
    newer
        Enter what differs from an image that is there as the newest.
    dry_run
        Read and check everything, and change nothing.
    """

    recorded_at: datetime | None = None
    newer: bool = False
    dry_run: bool = False


@dataclass(frozen=True)
class EnteredImages:
    """Enters images one after the other; where their noise matters, what is assumed of it is reported."""

    services: Services
    campaign: str
    listing: Listing
    settings: CameraSettings
    options: EntryOptions
    tell: Tell
    noise_counts: bool = True

    def all_of(self, inspected: list[Inspected]) -> Outcome:
        """Enter all that have no fault, and say what became of each."""
        good = [one for one in inspected if not one.found.faults]
        remarks = list(dict.fromkeys(r for one in good for r in one.remarks))
        cameras = dict(zip(map(id, good), self._cameras(good, remarks), strict=True)) if good else {}
        if self.noise_counts:
            catalogue, archive = self.services.catalogue, self.services.archive
            remarks += remarks_on_copies(good, imported_files(catalogue, archive, self.campaign))
        counted, rows = Counted(self.tell, "importing", len(inspected)), []
        for one in inspected:
            camera = cameras.get(id(one))
            if camera is None:
                rows.append(outcome_of(one, "refused", "; ".join(one.found.faults)))
            else:
                rows.append(self._one(one, camera))
            counted.one_more()
        return Outcome(tuple(rows), tuple(remarks))

    def _cameras(self, good: list[Inspected], remarks: list[str]) -> list[ImageCamera]:
        """Return of each image what its camera is, which files of one depth have in common."""
        given = self.settings
        scales = full_scales_of(good, given.full_scale, given.raw, remarks)
        remarks += remarks_on_textures(good, scales) if self.noise_counts else []
        cameras = {}
        for full_scale in dict.fromkeys(scales):
            gain, read_noise = given.gain, given.read_noise
            if gain is None or read_noise is None:
                usual = usual_noise(full_scale, remarks if self.noise_counts else [])
                gain = usual.gain if gain is None else gain
                read_noise = usual.read_noise if read_noise is None else read_noise
            cameras[full_scale] = ImageCamera(full_scale, gain, read_noise)
        return [cameras[full_scale] for full_scale in scales]

    def _one(self, one: Inspected, camera: ImageCamera) -> TupleOutcome:
        subject = Subject(self.campaign, one.found.state, one.found.view)
        digest = image_hash(one, self.settings.reading_options(), self.settings.raw)
        known = existing_measurement(self.services.catalogue, self.services.archive, subject, digest)
        if known.status == "there":
            return outcome_of(one, "already there", known.path)
        if self.options.dry_run:
            differs = known.status == "other" and not self.options.newer
            detail = "it already has another image: set `newer` to use this one" if differs else ""
            return outcome_of(one, "refused" if differs else "would be imported", detail)
        at = self.options.recorded_at or one.recorded_at
        try:
            done = import_measurement(
                self.services.catalogue,
                self.services.archive,
                subject,
                image_measurement(self.listing.folder, one, self.settings.raw, camera, at),
                digest,
                {
                    "folder": str(self.listing.folder),
                    "time_from": "given" if self.options.recorded_at else "files",
                    "remarks": list(one.remarks),
                    "files": [
                        {"name": name, "sha256": about.sha256, "shows": "image"}
                        for name, about in one.facts.items()
                    ],
                },
                datetime.now(UTC),
                newer=self.options.newer,
            )
        except (Conflict, InvalidInput) as error:
            return outcome_of(one, "refused", str(error))
        return outcome_of(one, "imported", done.path)
