"""What a camera alone measured as flat surfaces, read back by programs that are not ours."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest
from support.planes import moved_in_plane, one_region, plane, strain_in_plane

from sms_jobs.errors import InvalidInput
from sms_jobs.formats.exporters import all_exporters, exporter_named
from sms_jobs.formats.exporters.exporter import PointGrid
from sms_jobs.formats.exporters.sources import source_for
from sms_jobs.kinds.deformation import merge
from sms_jobs.kinds.deformation.merge import MergeParameters
from sms_jobs.kinds.kind import DatasetOutput, Inputs
from sms_jobs.kinds.products import MERGED, MESH
from sms_jobs.records.campaign import Campaign, LoadState, Specimen
from sms_jobs.records.fields import DisplacementField, MergedField, Mesh
from sms_jobs.records.reasons import Reason
from sms_jobs.records.subject import Subject
from sms_jobs.testing.in_memory import InMemory

SCALE = 0.05
SHAPE = (12, 20)
CAMPAIGN = Campaign("coupon", Specimen("coupon"), "camera", (LoadState("00"), LoadState("01")), ("C1",))
STATE = Subject("coupon", "01")


def merged(
    mm_per_px: float | None = None, step: int | None = 1, lost: bool = False
) -> tuple[DatasetOutput, DisplacementField]:
    """Merge a stretch along the columns with a hole in it; image rows point down."""
    row, column = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]].astype(np.float64)
    reason = np.zeros(SHAPE, np.uint32)
    reason[4:7, 8:12] = Reason.NO_MATCH
    if lost:
        reason[:] = Reason.NO_MATCH
    surface = plane(np.zeros(SHAPE, np.uint32), mm_per_px)
    moved = moved_in_plane(surface, 0.01 * column, 0.5 + 0.02 * row, reason)
    parameters = MergeParameters(mesh_step_px=step)
    records: dict[str, dict[str, Any]] = {
        "correlate": {"displacement": moved, "regions": one_region(surface)},
        "strain": {"strain": strain_in_plane(plane(reason, mm_per_px))},
        "plane": {"surface": surface},
    }
    needs = merge.KIND.checked_needs(CAMPAIGN, STATE, parameters)
    datasets = {need.role: InMemory(need.subject, records[need.source]) for need in needs}
    inputs = Inputs(STATE, merge.KIND.context(CAMPAIGN, STATE), datasets)
    (output,) = merge.KIND.run(inputs, parameters, lambda fraction, message="": None)
    assert isinstance(output, DatasetOutput)
    return output, moved


def mesh_of(output: DatasetOutput) -> Mesh:
    found = output.records[MESH.of("C1").stored_as]
    assert isinstance(found, Mesh)
    return found


def field_of(output: DatasetOutput) -> MergedField:
    found = output.records[MERGED.of("C1").stored_as]
    assert isinstance(found, MergedField)
    return found


@pytest.mark.parametrize("mm_per_px", [None, SCALE])
def test_a_flat_surface_moves_as_the_image_did(tmp_path: Path, mm_per_px: float | None) -> None:
    output, moved = merged(mm_per_px)
    mesh = mesh_of(output)
    path = tmp_path / "flat.vtu"
    exporter_named("vtu").write(mesh, path)
    read = meshio.read(path)
    scale, unit = (1.0, "px") if mm_per_px is None else (mm_per_px, "mm")
    data = {name: np.ravel(values) for name, values in read.point_data.items()}
    end = read.points[:, :2] + np.stack([data[f"displacement {a} [{unit}]"] for a in "XY"], axis=1)
    # Where a pixel has come to, in the image: x = column + u, and y up is minus (row + v).
    assert mesh.pixel is not None
    column, row = mesh.pixel
    u, v = moved.image_displacement[:, row, column]
    np.testing.assert_allclose(end, scale * np.stack([column + u, -(row + v)], axis=1), atol=1e-12)
    np.testing.assert_allclose(data["strain yy [1]"], 1e-3)
    assert not any("Z" in name for name in data)
    # Seen by the camera all triangles turn one way: none is mirrored.
    a, b, c = (read.points[read.cells_dict["triangle"][:, k]] for k in range(3))
    assert (np.cross(b - a, c - a)[:, 2] > 0.0).all()
    assert f"positions in {unit}" in path.read_bytes()[:200].decode()


def test_what_has_no_depth_has_no_z_in_the_archive() -> None:
    output, _ = merged()
    mesh, field = mesh_of(output), field_of(output)
    assert mesh.vertices.shape[1] == len(field.displacement) == len(field.position) == 2
    assert len(field.covariance) == 3
    assert "displacement Z" not in mesh.value_names
    assert output.statistics["maximum_displacement_px"] == pytest.approx(mesh.value("displacement").max())


@pytest.mark.parametrize("mm_per_px", [None, SCALE])
def test_every_format_takes_it_and_says_its_unit(tmp_path: Path, mm_per_px: float | None) -> None:
    output, _ = merged(mm_per_px)
    unit = "px" if mm_per_px is None else "mm"
    for name, exporter in all_exporters().items():
        path = tmp_path / f"flat-{name}{exporter.suffix}"
        of_image = exporter.takes == (PointGrid,)
        source = source_for(exporter, field_of(output) if of_image else mesh_of(output))
        if name == "e57" and mm_per_px is None:
            with pytest.raises(InvalidInput, match="E57 holds metres"):
                exporter.write(source, path)
            continue
        exporter.write(source, path)
        content = path.read_bytes()
        if name not in ("e57", "ptx", "matlab"):
            assert unit.encode() in content
            assert (b" mm" in content or b"[mm]" in content or b"_mm" in content) == (unit == "mm")


def test_pixels_are_written_in_the_unit_of_the_record(tmp_path: Path) -> None:
    _, moved = merged(SCALE)
    path = tmp_path / "pixels.csv"
    exporter_named("csv").write(source_for(exporter_named("csv"), moved), path)
    head = path.read_text().splitlines()[0]
    assert '"displacement X [mm]","displacement Y [mm]"' in head
    assert '"covariance XX [mm^2]' in head
    assert '"covariance YY [mm^2]' in head
    table = np.genfromtxt(path, delimiter=",", skip_header=1)
    assert len(table) == np.count_nonzero(moved.reason == 0)
    np.testing.assert_allclose(table[:, 2], SCALE * 0.01 * table[:, 0], atol=1e-9)
    with pytest.raises(InvalidInput, match="has no positions, which vtk needs"):
        source_for(exporter_named("vtk"), moved)


def test_a_mesh_is_as_fine_as_it_is_asked_for() -> None:
    assert len(mesh_of(merged(step=None)[0]).vertices) < len(mesh_of(merged(step=1)[0]).vertices)


def test_where_nothing_is_known_is_no_surface() -> None:
    assert mesh_of(merged(lost=True)[0]).faces.shape == (0, 3)
