"""The thesis's top hat: a speckled surface with steep sides, holes, shadows and occlusions."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from sms_jobs.kinds.shape.reconstruct import KIND, ReconstructParameters
from sms_jobs.metrology.images.segmentation import label_regions, pixel_footprint
from sms_jobs.records.fields import Surface
from sms_jobs.records.measurement import Measurement
from sms_jobs.records.reasons import Reason
from sms_jobs.records.scene import Simulation
from sms_jobs.records.sensors import Calibration
from sms_jobs.records.subject import Subject
from sms_jobs.testing.in_memory import run_kind
from sms_jobs.virtual_rig.campaigns import top_hat_bending
from sms_jobs.virtual_rig.rendering import render
from sms_jobs.virtual_rig.truth import Shape, exact_shape


@pytest.fixture(scope="module", params=["C1P1", "C2P1"])
def reconstructed(request: pytest.FixtureRequest) -> tuple[Calibration, Surface, Shape]:
    """A view that sees a side and one across whose sight the hat stands; cameras of 512 x 512 px."""
    view: str = request.param
    calibration, campaign = top_hat_bending("hat", "small")
    assert campaign.scene is not None
    subject = Subject("hat", "S00", view)
    simulation = Simulation(campaign.scene, view[:2], view[2:], (), state="S00")
    seen = render(simulation, campaign.sequence)
    measurement = Measurement(
        recorded_at=calibration.valid_from,
        sequence=campaign.sequence,
        full_scale=seen.full_scale,
        gain=seen.gain,
        read_noise=seen.read_noise,
        texture=seen.texture,
        frames=seen.frames,
    )
    records = {"measurement": measurement, "calibration": calibration}
    output = run_kind(KIND, subject, records, 1, ReconstructParameters())
    return calibration, output.records["surface"], exact_shape(simulation)


def test_nearly_every_pixel_that_is_seen_and_lit_has_a_good_point(
    reconstructed: tuple[Calibration, Surface, Shape],
) -> None:
    calibration, cloud, shape = reconstructed
    valid = cloud.reason == Reason.VALID
    # All but the outermost two pixels, which may share their light with something else: 0.2 % fail by noise,
    # and some lie where two surfaces meet within what is lit.
    inside = ndimage.binary_erosion(shape.seen & shape.lit, np.ones((3, 3)), iterations=2)
    assert valid[inside].mean() > 0.97
    assert not valid[~(shape.seen & shape.lit)].any()
    error = np.linalg.norm(cloud.position - shape.xyz, axis=0)[valid & shape.lit]
    # A pixel sees 1.3 mm; the noise alone is 0.03 mm and what the texture leaves another 0.05 mm.
    assert np.sqrt(np.mean(error**2)) < calibration.volume.diagonal_mm / 10_000.0
    assert np.quantile(error, 0.99) < 0.3


def test_stated_errors_are_those_that_happen(reconstructed: tuple[Calibration, Surface, Shape]) -> None:
    _, cloud, shape = reconstructed
    good = (cloud.reason == Reason.VALID) & shape.lit
    sigma = np.sqrt(cloud.covariance[[0, 3, 5]].sum(axis=0))
    z = np.linalg.norm(cloud.position - shape.xyz, axis=0)[good] / sigma[good]
    # What the texture leaves is no Gaussian, and its size is one number for a whole image: to a quarter.
    assert np.median(z) / 0.6745 == pytest.approx(1.0, abs=0.25)
    assert np.mean(z > 4.0) < 0.015


def test_the_hat_falls_into_the_pieces_that_occlusion_and_shadow_leave(
    reconstructed: tuple[Calibration, Surface, Shape],
) -> None:
    calibration, cloud, shape = reconstructed
    camera = calibration.rig.sensor(cloud.camera)
    valid = cloud.reason == Reason.VALID
    found = label_regions(
        cloud.position,
        valid,
        np.sqrt(cloud.covariance[[0, 3, 5]].sum(axis=0)).astype(np.float64),
        pixel_footprint(cloud.position, camera.intrinsics, camera.pose),
        minimum_area=100,
    )
    # C1P1 sees base, side and top as one sheet and the far base apart; C2P1's far base, top and near
    # base are parted by an occlusion and by a shadow.
    assert len(found.areas) == {"C1P1": 2, "C2P1": 3}[cloud.view]
    assert (found.labels[valid] > 0).mean() > 0.99
    for patch in np.unique(shape.region[shape.lit & valid]):
        labels = found.labels[(shape.region == patch) & shape.lit & valid]
        if labels.size > 1000:
            # A patch lies in one region, but for pixels whose light comes from across an edge.
            assert np.bincount(labels).max() > 0.999 * labels.size
