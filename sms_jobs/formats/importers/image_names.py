"""What the names of images say, guessed: which part is the state, and which is the camera."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath

from sms_jobs.errors import InvalidInput

_CAMERA = "{camera}"
_NUMBERS = re.compile(r"(\d+)")
_NUMBERS_AND_WORDS = re.compile(r"(\d+|[A-Za-z]+)")


@dataclass(frozen=True)
class _Reading:
    """A name as it may be read.

    Attributes
    ----------
    parts
        Of the name: what stays is at even places, what may vary at odd ones, and so is the camera.
    called
        What it calls its camera; empty where no cameras are named.
    """

    parts: tuple[str, ...]
    called: str

    @property
    def form(self) -> tuple[str, ...]:
        """What it has in common with names that differ in their numbers, or words, alone."""
        return tuple(_kind_of(part) if place % 2 else part for place, part in enumerate(self.parts))


def _kind_of(part: str) -> str:
    if part == _CAMERA:
        return part
    return "0" if part.isdecimal() else "a"


def guess_image_pattern(images: Sequence[str], cameras: Collection[str] = ()) -> str:
    """Return the pattern of the names that most images have.

    Without cameras what varies last is the state. With them it is the number that most states of all cameras
    have in common; names may then differ in words too, as those of `L_0001_0.tif` and `R_0001_1.tif` do.

    Parameters
    ----------
    cameras
        What the names call cameras.

    Raises
    ------
    InvalidInput
        Nothing of the names varies, or no part of them tells the cameras apart.
    """
    alike = _alike(images, cameras)
    varying = [k for k in range(1, len(alike[0].parts), 2) if len({one.parts[k] for one in alike}) > 1]
    common = {k: len(_common(alike, k)) for k in varying if alike[0].parts[k].isdecimal()}
    if cameras:
        common = {k: count for k, count in common.items() if count > 1}
    if not common:
        shown, form = images[0], "{state}_{camera}.png" if cameras else "{state}.png"
        besides = " but the camera" if cameras else ""
        raise InvalidInput(
            f"no part of the name {shown} varies{besides}: give a `pattern`, for example '{form}'"
        )
    state = max(common, key=lambda k: (common[k], k)) if cameras else max(common)
    return "".join(
        "{state}" if k == state else "*" if k in varying else part for k, part in enumerate(alike[0].parts)
    )


def _common(alike: Sequence[_Reading], place: int) -> set[str]:
    """Return what all cameras have at a place."""
    by_camera: defaultdict[str, set[str]] = defaultdict(set)
    for one in alike:
        by_camera[one.called].add(one.parts[place])
    return set.intersection(*by_camera.values())


def _alike(images: Sequence[str], cameras: Collection[str]) -> list[_Reading]:
    """Return the names of the form that most images have, of those forms that all cameras have."""
    for runs in (_NUMBERS, _NUMBERS_AND_WORDS) if cameras else (_NUMBERS,):
        forms: defaultdict[tuple[str, ...], list[_Reading]] = defaultdict(list)
        for name in images:
            for reading in _readings(name, cameras, runs):
                forms[reading.form].append(reading)
        whole = [f for f, found in forms.items() if {r.called for r in found} >= set(cameras)]
        if whole:
            # Of several that are as frequent that whose camera stands last.
            last = {f: f.index(_CAMERA) if cameras else 0 for f in whole}
            return forms[max(whole, key=lambda f: (len(forms[f]), last[f]))]
    lacking = [c for c in cameras if not any(_places(name, c) for name in images)]
    if lacking:
        raise InvalidInput(
            f"no name of an image has '{lacking[0]}' for a camera, as {images[0]}: correct `cameras`"
        )
    raise InvalidInput(
        f"the names of the cameras {', '.join(cameras)} differ in more than the camera, as {images[0]}: "
        "describe them with a `pattern` like '{camera}/load_{state}.png'"
    )


def _readings(name: str, cameras: Collection[str], runs: re.Pattern[str]) -> Iterator[_Reading]:
    """Yield a name as it is read without cameras, or with each place that may say one."""
    path = PurePosixPath(name)
    stem = str(path.with_suffix(""))
    if not cameras:
        yield _Reading((*runs.split(stem)[:-1], runs.split(stem)[-1] + path.suffix), "")
    for called in cameras:
        for start, end in _places(stem, called):
            before, after = runs.split(stem[:start]), runs.split(stem[end:])
            yield _Reading((*before, _CAMERA, *after[:-1], after[-1] + path.suffix), called)


def _places(text: str, called: str) -> list[tuple[int, int]]:
    """Return where a camera's name stands by itself: 0 not within 10, left not within leftover."""
    letter, number = "[A-Za-z]", r"\d"
    before = number if called[0].isdecimal() else letter
    after = number if called[-1].isdecimal() else letter
    found = re.finditer(f"(?<!{before}){re.escape(called)}(?!{after})", text)
    return [one.span() for one in found]
