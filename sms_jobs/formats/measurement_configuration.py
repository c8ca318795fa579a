"""Campaigns as XML in the structure of the thesis (section 4.5.2), for the same tables as the TOML files.

An XML file is turned into the nested table that a TOML file would give, and that is checked as any other. The
thesis's elements have their places in it:

filename
    `campaign`: its name, and that of its folder in the archive.
specimen
    The table [specimen].
hardware
    `rig`; the activated sensors by their indices in `cameras` and `projectors`, or `views`; the `scene` of a
    virtual rig.
acquisition
    `densities` and `orientations_deg` of [sequence]; `states`, the deformation sequence.
phase_analysis
    `steps` of [sequence]; the parameters of reconstruct.
calibration
    Of a virtual rig: `sensors`, `volume`, `valid_from`.
dic, strain
    The parameters of correlate and of strain.
processing
    The parameters of any other kind, in an element of its name.
session
    The table [session] of a calibration session.
"""

from __future__ import annotations

from typing import Any

from sms_jobs.errors import ConfigurationError
from sms_jobs.formats.interchange.xml_elements import Element, parse_xml
from sms_jobs.formats.interchange.xml_values import Path, Places, value_of
from sms_jobs.records.views import Role, View, sensor_name

_WHOLE: dict[str, Path] = {
    "specimen": ("specimen",),
    "session": ("session",),
    "dic": ("processing", "correlate"),
    "strain": ("processing", "strain"),
}
"""Elements that are one table of the campaign."""

_PARTS: dict[str, dict[str, Path]] = {
    "filename": {"campaign": ("name",)},
    "hardware": {"rig": ("rig",), "views": ("views",)},
    "acquisition": {
        "densities": ("sequence", "densities"),
        "orientations_deg": ("sequence", "orientations_deg"),
        "states": ("states",),
    },
    "phase_analysis": {"steps": ("sequence", "steps")},
    "calibration": {
        "sensors": ("scene", "sensors"),
        "volume": ("scene", "volume"),
        "valid_from": ("scene", "calibration_valid_from"),
    },
    "processing": {},
}
"""Elements whose children go to several places of the campaign."""

_OTHERS: dict[str, Path] = {"phase_analysis": ("processing", "reconstruct"), "processing": ("processing",)}
"""Where children go that `_PARTS` does not name."""


def parse_measurement_configuration(text: str, source: str) -> tuple[dict[str, Any], Places]:
    """Return the nested table of a campaign that a text describes, and where its values stand in the text.

    Raises
    ------
    ConfigurationError
        The text is not well-formed, declares a document type, or has elements of other names; the message
        names `source`, line and element.
    """
    root = parse_xml(text, source)
    if root.name != "sms":
        raise ConfigurationError(f"{source} should begin with the element <sms>, not <{root.name}>")
    places = Places(source)
    places.add((), "sms", root.line)
    content: dict[str, Any] = {}
    seen: set[str] = set()
    for section in root.children:
        name = f"sms/{section.name}"
        if section.name in seen:
            raise places.refused(section, name, "stands here twice")
        seen.add(section.name)
        if section.name in _WHOLE:
            _put(content, _WHOLE[section.name], value_of(section, places, name, _WHOLE[section.name]))
        elif section.name in _PARTS:
            _take_apart(section, content, places)
        else:
            known = ", ".join(sorted({**_WHOLE, **_PARTS}))
            raise places.refused(
                section, name, f"sms has no element {section.name}; its elements are {known}"
            )
    return content, places


def _take_apart(section: Element, content: dict[str, Any], places: Places) -> None:
    """Bring the children of an element to their places in the campaign."""
    name = f"sms/{section.name}"
    parts = _PARTS[section.name]
    if section.text.strip() or section.attributes:
        raise places.refused(section, name, "holds other elements alone, without text or attributes")
    seen: dict[str, Any] = {}
    for child in section.children:
        if child.name in seen:
            raise places.refused(child, f"{name}/{child.name}", "stands here twice")
        path = parts.get(child.name)
        if path is None and section.name in _OTHERS:
            path = (*_OTHERS[section.name], child.name)
        if path is not None:
            _put(content, path, value_of(child, places, f"{name}/{child.name}", path))
        elif section.name == "hardware" and child.name == "scene":
            # Sensors and volume of the scene stand under <calibration>, so the two are laid together.
            scene = value_of(child, places, f"{name}/scene", ("scene",))
            if not isinstance(scene, dict):
                raise places.refused(child, f"{name}/scene", "should hold other elements")
            for key, value in scene.items():
                _put(content, ("scene", key), value)
        elif section.name == "hardware" and child.name in ("cameras", "projectors"):
            seen[child.name] = (child, value_of(child, places, f"{name}/{child.name}", ("views",)))
            continue
        else:
            known = ", ".join(
                [*parts, *(("cameras", "projectors", "scene") if section.name == "hardware" else ())]
            )
            raise places.refused(
                child, f"{name}/{child.name}", f"{section.name} has no such element; its elements are {known}"
            )
        seen[child.name] = None
    if "cameras" in seen or "projectors" in seen:
        _activate(section, seen, content, places)


def _activate(section: Element, seen: dict[str, Any], content: dict[str, Any], places: Places) -> None:
    """Make views of the activated cameras and projectors: every camera with every projector."""
    if "views" in content or not {"cameras", "projectors"} <= seen.keys():
        raise places.refused(
            section, "sms/hardware", "needs either cameras and projectors, or views, and not both"
        )
    names: dict[str, list[str]] = {}
    for kind, role in (("cameras", Role.CAMERA), ("projectors", Role.PROJECTOR)):
        child, indices = seen[kind]
        listed = indices if isinstance(indices, list) else [indices]
        for index in listed:
            if isinstance(index, bool) or not isinstance(index, int) or index < 1:
                raise places.refused(
                    child,
                    f"sms/hardware/{kind}",
                    f"should hold the indices of {kind}, such as 1 2, not '{index}'",
                )
        names[kind] = [sensor_name(role, index) for index in listed]
    content["views"] = [
        str(View(camera, (projector,))) for camera in names["cameras"] for projector in names["projectors"]
    ]


def _put(content: dict[str, Any], path: Path, value: Any) -> None:
    """Set a value of a nested table, making the tables on the way."""
    table = content
    for key in path[:-1]:
        table = table.setdefault(str(key), {})
    last = str(path[-1])
    if isinstance(value, dict) and isinstance(table.get(last), dict):
        table[last].update(value)
    else:
        table[last] = value
