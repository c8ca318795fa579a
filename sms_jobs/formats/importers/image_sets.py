"""Folders of images of one camera or several, without a projector: one image a state and camera."""

from __future__ import annotations

import hashlib
import json
import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

import numpy as np

from sms_jobs.errors import InvalidInput
from sms_jobs.formats.importers.folders import LeftOut, Listing, NamePattern, natural
from sms_jobs.formats.importers.frames import Arrangement, FoundTuple, abridged, is_image
from sms_jobs.formats.importers.image_files import RawFormat, read_image
from sms_jobs.formats.importers.inspection import Inspected
from sms_jobs.records.measurement import ArrayStack, FringeSequence, Measurement
from sms_jobs.records.subject import checked_name
from sms_jobs.records.views import CAMERA_PATTERN

_CAMERA = re.compile(CAMERA_PATTERN)
_NAMED = re.compile(rf"(?P<called>[^=\s]+)=(?P<name>{CAMERA_PATTERN})")


@dataclass(frozen=True)
class ImageCamera:
    """What is known of the camera: full scale and noise in grey levels."""

    full_scale: int
    gain: float
    read_noise: float


def named_cameras(text: str | None) -> dict[str, str]:
    """Return cameras by what file names call them, from `left=C1 right=C2`; `InvalidInput` for others."""
    named: dict[str, str] = {}
    for part in (text or "").split():
        found = _NAMED.fullmatch(part)
        if found is None:
            raise InvalidInput(
                f"`cameras` should say which camera is which, as in 'left=C1 right=C2', not '{part}'"
            )
        twice = found["called"] if found["called"] in named else found["name"]
        if twice in (*named, *named.values()):
            raise InvalidInput(f"`cameras` name {twice} twice in '{text}': name each camera once")
        named[found["called"]] = found["name"]
    return named


def arrange_images(
    listing: Listing,
    pattern: NamePattern,
    camera: str | None,
    reference: str | None,
    cameras: Mapping[str, str] | None = None,
) -> Arrangement:
    """Sort images into states and cameras by their names; nothing is read.

    Parameters
    ----------
    camera
        Of images whose names do not say it.
    reference
        State that comes first.
    cameras
        Cameras by what the names call them.

    Raises
    ------
    InvalidInput
        The pattern does not say the state, or says what has no place here; the camera is no name of one; no
        image is of the reference.
    """
    foreign = [n for n in pattern.names if n not in ("state", "camera")]
    if "state" not in pattern.names or foreign:
        raise InvalidInput(
            f"the pattern '{pattern.text}' of images has to have {{state}} and may have {{camera}} and *, "
            "nothing else"
        )
    if cameras and "camera" not in pattern.names:
        raise InvalidInput(
            f"the pattern '{pattern.text}' does not say where names have the cameras {', '.join(cameras)}: "
            "write {camera} there, or leave out `cameras`"
        )
    if camera is not None and not _CAMERA.fullmatch(camera):
        raise InvalidInput(f"'{camera}' is no camera: write it like C1")
    left_out = list(listing.left_out)
    groups: dict[tuple[str, str], list[str]] = {}
    for name in listing.files:
        said = pattern.match(name)
        if said is None or not is_image(name):
            left_out.append(LeftOut(name, "does not fit the pattern" if is_image(name) else "is no image"))
            continue
        called = said.get("camera", camera or "C1")
        groups.setdefault((said["state"], (cameras or {}).get(called, called)), []).append(name)
    states = {state for state, _ in groups}
    if reference is not None and reference not in states:
        raise InvalidInput(
            f"no image shows the reference {reference}; there are "
            f"{', '.join(sorted(states, key=natural)[:10]) or 'none'}"
        )
    tuples = [_found(state, name, files) for (state, name), files in groups.items()]
    tuples.sort(key=lambda t: (t.state != reference, natural(t.state), natural(t.view)))
    return Arrangement(tuple(tuples), tuple(left_out))


def _found(state: str, camera: str, files: list[str]) -> FoundTuple:
    faults = []
    try:
        checked_name(state, "state")
    except InvalidInput as error:
        faults.append(str(error))
    if len(files) > 1:
        faults.append(
            f"{' and '.join(files[:3])} are of one state and camera: take all but one out of the folder, or "
            "give `cameras` as they are called in the names, for example 'left=C1 right=C2'"
        )
    return FoundTuple(state, camera, white=files[0], faults=tuple(faults))


def of_one_size(inspected: list[Inspected]) -> list[Inspected]:
    """Add a fault to the images whose size is not that of most of their camera's."""
    checked = []
    for one in inspected:
        mine = _size(one)
        sizes = Counter(_size(i) for i in inspected if i.found.view == one.found.view and not i.found.faults)
        usual = sizes.most_common(1)[0][0] if sizes else mine
        if mine == usual or one.found.faults:
            checked.append(one)
            continue
        fault = f"it has {mine} and the others of {one.found.view} {usual}: crop them alike, or leave it out"
        checked.append(replace(one, found=replace(one.found, faults=abridged([*one.found.faults, fault]))))
    return checked


def _size(one: Inspected) -> str:
    for about in one.facts.values():
        return f"{about.columns} x {about.rows} px"
    return "no image"


def image_hash(one: Inspected, given: Mapping[str, float | None], raw: RawFormat | None) -> str:
    """Return the SHA-256 of what the measurement is made of: its file, and what is said of it."""
    parts = {"image": [about.sha256 for about in one.facts.values()], "camera": dict(given)}
    parts |= {} if raw is None else raw.said_of(one.facts)
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()


def image_measurement(
    folder: Path, one: Inspected, raw: RawFormat | None, camera: ImageCamera, recorded_at: datetime
) -> Measurement:
    """Return an image as a measurement: it is the texture, and the only frame; nothing was projected."""
    assert one.found.white is not None
    levels, about = read_image(folder / one.found.white, raw)
    if about.sha256 != one.facts[one.found.white].sha256:
        raise InvalidInput(f"{one.found.white} was changed while it was imported: import it again")
    return Measurement(
        recorded_at=recorded_at,
        sequence=FringeSequence(),
        full_scale=camera.full_scale,
        gain=camera.gain,
        read_noise=camera.read_noise,
        texture=levels.astype(np.uint16),
        frames=ArrayStack(levels[None]),
    )
