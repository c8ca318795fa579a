"""Plausible results of a small campaign, in a real archive, and a kind run on them."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from sms_jobs.archive import Archive, FolderStore, Provenance
from sms_jobs.kinds.documents import DocumentOutput
from sms_jobs.kinds.kind import CALIBRATION, MEASUREMENT, Inputs, Need
from sms_jobs.kinds.products import MERGED
from sms_jobs.metrology.geometry.camera import Pose
from sms_jobs.metrology.geometry.lens import Intrinsics
from sms_jobs.records.assessment import Assessment, Errors
from sms_jobs.records.campaign import Campaign, LoadState, Specimen
from sms_jobs.records.fields import MergedField, Mesh, Region, Regions, StrainField, Surface
from sms_jobs.records.gauges import GaugeReadings
from sms_jobs.records.measurement import ArrayStack, FringeSequence, Measurement
from sms_jobs.records.scene import HalvesApart, Plane, Scene
from sms_jobs.records.sensors import Box, Calibration, Rig, Sensor
from sms_jobs.records.subject import Subject
from sms_jobs.records.views import Role

WHEN = datetime(2026, 1, 2, 3, 4, 5, tzinfo=UTC)
CAMERAS = ("C1", "C2")
POSE = Pose(((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)), (0.0, 0.0, 500.0))


def campaign(
    states: int = 2, virtual: bool = True, material: str = "", views: tuple[str, ...] = ("C1P1",)
) -> Campaign:
    loads = tuple(
        LoadState(f"S{i:02}", load_n=1234.5 * i, deformation=(HalvesApart(0.1 * i),)) for i in range(states)
    )
    scene = Scene(Rig("rig", ()), Plane(100.0, 100.0)) if virtual else None
    specimen = Specimen("panel", material=material)
    return Campaign("plate", specimen, "rig", loads, views, scene=scene)


def grid(size: tuple[int, int]) -> Any:
    y, x = np.mgrid[0 : size[0], 0 : size[1]]
    scale = 300.0 / size[1]
    return x * scale, y * scale, 40.0 * np.cos(x * scale / 60.0)


def records_for(need: Need, size: tuple[int, int]) -> Mapping[str, Any]:
    """Return plausible results for what the report needs."""
    rng = np.random.default_rng(1)
    x, y, z = grid(size)
    load = int((need.subject.state or "S00")[1:])
    reason = np.zeros(size, np.uint32)
    reason[: size[0] // 5, : size[1] // 4] = 1
    hole = np.where(reason > 0, np.nan, 1.0)
    full = np.stack([hole] * 3)
    covariance = np.full((6, *size), 1e-4, np.float32) * np.concatenate([full, full]).astype(np.float32)
    shift = np.stack([0.01 * x, -0.003 * y, 0.2 * z]) * 0.1 * load * full
    errors = Errors(100, 0.02, 0.001, 0.1, 1.05, 120, 0.97, 0)
    if need.source == CALIBRATION:
        sensor = Sensor("C1", Role.CAMERA, size[1], size[0], Intrinsics(1e3, 1e3, 40.0, 30.0), POSE)
        box = Box((0.0, 0.0, 0.0), (300.0, 400.0, 0.0))
        return {"calibration": Calibration(Rig("rig", (sensor,)), box, WHEN, "exact")}
    if need.source == MEASUREMENT:
        texture = (1500 + 700 * np.sign(np.sin(x) * np.sin(y)) + rng.normal(0, 40, size)).astype(np.uint16)
        frames = ArrayStack(texture[None])
        return {"measurement": Measurement(WHEN, FringeSequence(), 4095, 0.1, 2.0, texture, frames)}
    if need.source == "reconstruct":
        gap = np.zeros(size, np.float32)
        if need.subject.view == "C1P1":
            reason = reason | 1  # sees nothing: its neighbour C1P2 is shown
        return {"surface": Surface("C1P1", "mm", np.stack([x, y, z]) * full, reason, covariance, gap)}
    if need.source == "correlate":
        labels = np.where(z > 0, 1, 2).astype(np.int32) * (reason == 0)
        return {
            "regions": Regions((Region(1, 9, (1.0, 1.0)), Region(2, 8, (1.0, 1.0))), labels.astype(np.int32))
        }
    if need.source == "strain":
        strain = np.stack([0.001 + 1e-5 * x, -0.0003 + 0 * x, 0 * x]) * load * full
        sigma = np.full((3, *size), 3e-5, np.float32)
        return {"strain": StrainField("small", "mm", 20.0, strain, sigma, strain[:2], strain[0], reason)}
    if need.source == "merge":
        names = np.ones(size, np.uint8)
        fields = {
            MERGED.of(c).stored_as: MergedField(
                c, ("C1P1", "C1P2"), "mm", 0.012, shift, np.stack([x, y, z]), covariance, names, reason
            )
            for c in CAMERAS
        }
        return {**fields, "mesh": mesh()}
    if need.source == "gauges":
        readings = np.array([0.001 * load, np.nan]), np.array([2e-6, np.nan], np.float32)
        return {
            "gauges": GaugeReadings(
                "small", ("G1", "<G2>"), *readings, np.zeros((2, 3)), np.zeros(2, np.int32)
            )
        }
    assert need.source == "assess", need
    return {"assessment": Assessment(errors, errors, replace(errors, rms=42e-6), np.zeros(size, np.float32))}


def mesh(cameras: tuple[str, ...] = ("C1",)) -> Mesh:
    corners = np.array([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0], [0.0, 10.0, 0.0]])
    return Mesh(
        ("displacement X",),
        ("mm",),
        corners,
        np.array([[0, 1, 2]], np.int32),
        np.ones((1, 3)),
        cameras=cameras,
        camera=np.zeros(3, np.uint8),
        pixel=np.array([[5, 6, 5], [3, 3, 4]], np.int32),
    )


def run_on_results(
    folder: Path,
    kind: Any,
    campaign: Campaign,
    subject: Subject,
    size: tuple[int, int] = (45, 60),
    instead: Any = None,
    heard: list[str] | None = None,
    **given: Any,
) -> list[tuple[DocumentOutput, Path]]:
    """Run a kind on files of an archive in a folder; what it writes lands beside it.

    `instead` are records that take the place of those of their name; `heard` gets the words of its progress.
    """
    archive = Archive(FolderStore(folder / "archive"))
    with ExitStack() as stack:
        datasets = {}
        parameters = kind.parameters(**given)
        for place, need in enumerate(kind.checked_needs(campaign, subject, parameters)):
            made = Provenance(
                need.source,
                1,
                need.subject,
                f"{place:032x}",
                place,
                WHEN,
                {"a<b": 1},
                (),
                "0.1",
                "h<1>",
                "me",
            )
            usual = records_for(need, size)
            records = {name: (instead or {}).get(name, record) for name, record in usual.items()}
            sealed = archive.seal_dataset(records, made)
            datasets[need.role] = stack.enter_context(archive.open(sealed))
        inputs = Inputs(subject, kind.context(campaign, subject), datasets)
        told: list[float] = []
        documents = []

        def progress(part: float, words: str = "") -> None:
            told.append(part)
            if heard is not None:
                heard.append(words)

        outputs = kind.run(inputs, parameters, progress)
        for output in map(kind.checked, outputs):
            path = folder / output.filename
            output.write(path)
            documents.append((output, path))
        assert told == sorted(told)
        assert 0.0 <= told[0] <= told[-1] <= 1.0
    return documents
