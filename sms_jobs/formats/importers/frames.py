"""Folders of frames: which files make which tuple, by their names alone."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import degrees
from pathlib import Path
from typing import Any

from sms_jobs.errors import InvalidInput
from sms_jobs.formats.importers.folders import LeftOut, Listing, natural, printable
from sms_jobs.formats.importers.image_files import RAW_SUFFIXES, SUFFIXES
from sms_jobs.formats.importers.layout import FrameLayout, Role
from sms_jobs.records.subject import checked_name
from sms_jobs.records.views import View, is_view, view_of

_FAULTS_SHOWN = 4


@dataclass(frozen=True)
class FoundTuple:
    """The files of one state and view.

    Attributes
    ----------
    state, view
        What they are of.
    fringes, code
        Relative paths in the order of the measurement's stacks.
    white
        Of the white frame, if there is one.
    faults
        Why it cannot be imported; empty when it can.
    """

    state: str
    view: str
    fringes: tuple[str, ...] = ()
    code: tuple[str, ...] = ()
    white: str | None = None
    faults: tuple[str, ...] = ()

    @property
    def stack(self) -> tuple[str, ...]:
        """The frames of the measurement, in its order."""
        return self.fringes + self.code

    @property
    def files(self) -> tuple[str, ...]:
        """All of its files."""
        return self.stack + (() if self.white is None else (self.white,))


@dataclass(frozen=True)
class Arrangement:
    """What a folder holds, as a layout reads it."""

    tuples: tuple[FoundTuple, ...]
    left_out: tuple[LeftOut, ...]

    @property
    def states(self) -> tuple[str, ...]:
        """Labels of all states, in order."""
        return tuple(dict.fromkeys(t.state for t in self.tuples))

    @property
    def labels(self) -> tuple[str, ...]:
        """Those of the states that can be labels: others are faults of their tuples."""
        return tuple(label for label in self.states if is_name(label))

    @property
    def views(self) -> tuple[str, ...]:
        """All views that can be, in order."""
        return tuple(sorted({t.view for t in self.tuples if is_view(t.view)}, key=natural))


def is_name(label: str) -> bool:
    """Say whether a text can be the label of a state."""
    try:
        checked_name(label, "state")
    except InvalidInput:
        return False
    return True


_Key = tuple[str, str]


def is_image(name: str) -> bool:
    """Say whether a name is that of an image or of raw data."""
    return Path(name).suffix.lower() in SUFFIXES | RAW_SUFFIXES


def arrange(listing: Listing, layout: FrameLayout) -> Arrangement:
    """Sort files into tuples by their names; nothing is read.

    Files that the pattern does not fit are left out; of those that it fits, all of a tuple have to be there.
    """
    left_out = list(listing.left_out)
    groups: dict[_Key, list[tuple[str, dict[str, str]]]] = {}
    faults: dict[_Key, list[str]] = {}
    for name in listing.files:
        said = layout.pattern.match(name)
        if said is None:
            why = "does not fit the pattern" if is_image(name) else "is no image"
            left_out.append(LeftOut(name, why))
            continue
        if not is_image(name):
            left_out.append(LeftOut(name, "fits the pattern, but is no image"))
            continue
        state, why = _state_of(layout, said)
        if state is None:
            left_out.append(LeftOut(name, why))
            continue
        key = (state, _view_of(layout, said))
        groups.setdefault(key, []).append((name, said))
        if why:
            faults.setdefault(key, []).append(why)
    sort = _sorter(layout, groups)
    tuples = [sort(key, files, faults.get(key, [])) for key, files in groups.items()]
    return Arrangement(tuple(sorted(tuples, key=lambda t: _order(layout, t))), tuple(left_out))


def _state_of(layout: FrameLayout, said: Mapping[str, str]) -> tuple[str | None, str]:
    """Return the label of a state, or None, and what is wrong with it."""
    text = said.get("state", layout.state or "")
    label = layout.states.get(text, text)
    if label is False:
        return None, f"is of {text}, which the layout leaves out"
    try:
        return checked_name(label, "state"), ""
    except InvalidInput as error:
        return printable(label), f"{error}; map it to a label, as in [states] '{printable(text)}' = 'S01'"


def _view_of(layout: FrameLayout, said: Mapping[str, str]) -> str:
    if "camera" in said:
        return said["camera"] + said["projector"]
    return said.get("view", layout.view or "")


def _order(layout: FrameLayout, one: FoundTuple) -> tuple[int, Any, Any]:
    """States in the order of the layout, then in natural order of their labels."""
    listed = [label for label in layout.states.values() if label]
    place = listed.index(one.state) if one.state in listed else len(listed)
    return place, natural(one.state), natural(one.view)


def _sorter(
    layout: FrameLayout, groups: Mapping[_Key, list[tuple[str, dict[str, str]]]]
) -> Callable[[_Key, list[tuple[str, dict[str, str]]], list[str]], FoundTuple]:
    """Return what makes a tuple of its files; where numbers and steps begin is the same for all of them."""
    everything = [said for files in groups.values() for _, said in files]
    steps = sorted({float(said["step"]) for said in everything if "step" in said})
    numbers = [int(said["number"]) for said in everything if "number" in said]
    first = layout.first if layout.first is not None else min(numbers, default=0)

    def sort(key: _Key, files: list[tuple[str, dict[str, str]]], faults: list[str]) -> FoundTuple:
        wrong = list(dict.fromkeys(faults))
        try:
            _require_frames(view_of(key[1]))
        except InvalidInput as error:
            wrong.append(str(error))
        named: dict[Role, list[str]] = {}
        wrong += _beyond(layout, [int(said["number"]) for _, said in files if layout.numbered], first)
        for name, said in files:
            role = _numbered(layout, said, first) if layout.numbered else _spoken(layout, said, steps)
            if role is None:
                continue
            if isinstance(role, Role):
                named.setdefault(role, []).append(name)
            else:
                wrong.append(f"{name}: {role}")
        wrong += [
            f"{' and '.join(names)} are the same frame: take all but one out of the folder"
            for role, names in named.items()
            if len(names) > 1 and role.kind != "skip"
        ]
        wrong += _missing(layout, named, first)
        if wrong:
            return FoundTuple(*key, tuple(n for n, _ in files), faults=abridged(wrong))
        return _complete(layout, key, {role: names[0] for role, names in named.items()})

    return sort


def _require_frames(view: View) -> None:
    """Raise `InvalidInput` for a view that frames of fringes are not recorded of."""
    if view.projector and view.other_cameras:
        recorded = " and ".join(map(str, view.recordings))
        raise InvalidInput(f"the view {view} is recorded as {recorded}: name the frames of each camera so")


def abridged(faults: Sequence[str]) -> tuple[str, ...]:
    """Return the first faults, and how many there are besides."""
    more = len(faults) - _FAULTS_SHOWN
    return (*faults[:_FAULTS_SHOWN], f"and {more} more faults") if more > 0 else tuple(faults)


def _numbered(layout: FrameLayout, said: Mapping[str, str], first: int) -> Role | None:
    """Return what a numbered frame is; None for one that the layout does not have."""
    place = int(said["number"]) - first
    return layout.roles[place] if 0 <= place < len(layout.roles) else None


def _beyond(layout: FrameLayout, numbers: list[int], first: int) -> list[str]:
    """Say which numbers the layout does not have."""
    last = first + len(layout.roles) - 1
    beyond = sorted(n for n in numbers if not first <= n <= last)
    if not beyond:
        return []
    listed = ", ".join(map(str, beyond[:8])) + (f" and {len(beyond) - 8} more" if len(beyond) > 8 else "")
    return [f"frames {listed} are more than the {len(layout.roles)} of the layout, {first} .. {last}"]


def _spoken(layout: FrameLayout, said: Mapping[str, str], steps: list[float]) -> Role | str:
    """Return what a frame is whose name says density and step, or what is wrong with it."""
    sequence = layout.sequence
    density = float(said.get("density", sequence.densities[0]))
    if density not in sequence.densities:
        return f"density {density:g} is none of {', '.join(map(str, sequence.densities))}"
    if len(steps) > sequence.steps:
        return f"steps {', '.join(f'{s:g}' for s in steps[:12])} are more than the {sequence.steps} there are"
    angles = [round(degrees(a), 6) for a in sequence.orientations_rad]
    text = said.get("orientation")
    if text is None and len(angles) > 1:
        return f"the names do not say which of {len(angles)} orientations it is: write {{orientation}}"
    angle = angles[0] if text is None else _angle(layout, text)
    if angle not in angles:
        return (
            f"orientation '{text}' is none of {', '.join(f'{a:g}' for a in angles)} deg: see [orientations]"
        )
    step = steps.index(float(said["step"]))
    return layout.fringe(angles.index(angle), sequence.densities.index(density), step)


def _angle(layout: FrameLayout, text: str) -> float | None:
    if text in layout.orientation_names:
        return round(layout.orientation_names[text], 6)
    try:
        return round(float(text), 6)
    except ValueError:
        return {"x": 0.0, "y": 90.0}.get(text.lower())


def _missing(layout: FrameLayout, named: Mapping[Role, list[str]], first: int) -> list[str]:
    """Say which frames are not there."""
    lacking = [i for i, role in enumerate(layout.roles) if role.kind != "skip" and role not in named]
    if not lacking:
        return []
    if layout.numbered:
        listed = ", ".join(str(first + i) for i in lacking[:8])
        more = f" and {len(lacking) - 8} more" if len(lacking) > 8 else ""
        return [f"frames {listed}{more} are missing of {len(layout.roles)}"]
    patterns = list(layout.sequence.patterns())
    at = [patterns[layout.roles[i].index] for i in lacking[:4]]
    listed = "; ".join(f"{degrees(o):g} deg, density {t:g}, step {k}" for o, t, k in at)
    more = f" and {len(lacking) - 4} more" if len(lacking) > 4 else ""
    return [f"frames are missing: {listed}{more}"]


def _complete(layout: FrameLayout, key: _Key, named: Mapping[Role, str]) -> FoundTuple:
    def stack(kind: str) -> tuple[str, ...]:
        found = {role.index: name for role, name in named.items() if role.kind == kind}
        return tuple(found[i] for i in sorted(found))

    white, black = named.get(Role("white")), named.get(Role("black"))
    code = stack("code")
    if layout.sequence.gray is not None and layout.sequence.gray.threshold == "white-black":
        assert white is not None
        assert black is not None
        code = (*code, white, black)
    return FoundTuple(*key, stack("fringe"), code, white)


def role_descriptions(layout: FrameLayout, found: FoundTuple) -> Iterator[tuple[str, str]]:
    """Yield each file of a complete tuple and what it shows, in words."""
    for name, (angle, density, step) in zip(found.fringes, layout.sequence.patterns(), strict=True):
        yield name, f"{density:g} fringe{'s' * (density != 1)} along {degrees(angle):g} deg, step {step}"
    for name, stripes in zip(found.code, layout.sequence.code_patterns(), strict=True):
        inverted = " inverted" if stripes.inverted else ""
        if stripes.bit is not None:
            yield (
                name,
                f"Gray code bit {stripes.bit} along {degrees(stripes.orientation_rad):g} deg{inverted}",
            )
        elif stripes.inverted:
            yield name, "black"
    if found.white is not None:
        yield found.white, "white"
