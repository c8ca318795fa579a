"""The standard campaigns: in the volume and the image, at useful angles, partly hidden as in the thesis."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from sms_jobs.errors import InvalidInput
from sms_jobs.metrology.geometry.transforms import inverse, transform
from sms_jobs.records.campaign import Campaign
from sms_jobs.records.scene import AT_ORIGIN, Simulation, StiffenedPanel, StringerCrack
from sms_jobs.records.sensors import Calibration
from sms_jobs.records.views import view_of
from sms_jobs.virtual_rig.campaigns import (
    hole_and_step_translation,
    plate_and_mirror,
    small_plate,
    tension_panel,
    top_hat_bending,
)
from sms_jobs.virtual_rig.deformations import carried_points, gradients, packed_chain
from sms_jobs.virtual_rig.exact_meshes import exact_mesh
from sms_jobs.virtual_rig.light import trace
from sms_jobs.virtual_rig.rendering import render
from sms_jobs.virtual_rig.truth import exact_shape, exact_truth
from sms_jobs.virtual_rig.wing_campaigns import (
    GAUGES_MM,
    TABLE_5,
    buckling_panel,
    cracked_wing_panel,
    disbond_buckling,
    wing_panel,
)

HAT = top_hat_bending("hat", "small")[1]
PRINTED = [
    small_plate("plate"),
    top_hat_bending("hat", "small"),
    hole_and_step_translation("step", "small"),
    tension_panel("panel", "small"),
    disbond_buckling("stringer", "small"),
    buckling_panel("buckling", "small"),
]
NAMES = ["plate", "hat", "step", "panel", "stringer", "buckling"]


def simulation(campaign: Campaign, state: int, view: str) -> Simulation:
    assert campaign.scene is not None
    load = campaign.states[state]
    return Simulation(campaign.scene, *view_of(view).sensors, load.deformation, load.label)


@pytest.mark.parametrize(("calibration", "campaign"), PRINTED, ids=NAMES)
def test_every_state_stays_in_the_volume_and_in_the_image(
    calibration: Calibration, campaign: Campaign
) -> None:
    low, high = (np.array(c)[:, None, None] for c in (calibration.volume.low, calibration.volume.high))
    for state in (0, len(campaign.states) - 1):
        for view in campaign.views:
            shape = exact_shape(simulation(campaign, state, view))
            inside = (shape.xyz > low) & (shape.xyz < high)
            assert inside.all(axis=0)[shape.seen].all()
            border = np.ones_like(shape.seen)
            border[2:-2, 2:-2] = False
            assert not shape.seen[border].any()
            assert shape.seen.mean() > 0.4


@pytest.mark.parametrize(("calibration", "campaign"), PRINTED, ids=NAMES)
def test_rays_meet_at_a_useful_angle(calibration: Calibration, campaign: Campaign) -> None:
    for view in campaign.views:
        camera, projector = (calibration.rig.sensor(name).pose.centre() for name in view_of(view).sensors)
        cosine = camera @ projector / np.linalg.norm(camera) / np.linalg.norm(projector)
        assert np.degrees(np.arccos(cosine)) > 25.0


def test_the_calibration_is_the_truth_and_the_states_are_in_order() -> None:
    for calibration, campaign in PRINTED:
        assert campaign.scene is not None
        assert campaign.scene.rig == calibration.rig
        assert campaign.views == calibration.rig.views()
        assert campaign.reference.deformation == ()
        loads = [s.load_n for s in campaign.states]
        times = [s.time for s in campaign.states]
        assert loads == sorted(loads, key=lambda load: load or 0.0)
        assert times == sorted(times, key=str)


def test_crossed_pairs_miss_the_side_that_straight_pairs_see() -> None:
    campaign = HAT
    lit = {}
    for view in campaign.views:
        shape = exact_shape(simulation(campaign, 0, view))
        sides = {region: shape.lit & (shape.region == region) for region in (2, 3, 4)}
        lit[view] = {region: int(part.sum()) for region, part in sides.items()}
    assert lit["C1P1"][2] > 10_000
    assert lit["C1P2"][2] == 0
    assert lit["C2P2"][4] > 10_000
    assert lit["C2P1"][4] == 0
    assert all(found[3] > 20_000 for found in lit.values())
    # What a scanner sees of the far base is cut off by the top: there is a real silhouette in its image.
    assert lit["C1P1"][4] == lit["C2P2"][2] == 0


def test_light_is_neither_scarce_nor_too_much() -> None:
    for _, campaign in PRINTED:
        for view in campaign.views:
            sim = simulation(campaign, 0, view)
            rendering = render(sim, replace(campaign.sequence, densities=(8,)))
            lit = exact_shape(sim).lit
            assert (rendering.texture < rendering.full_scale).all()
            assert np.percentile(rendering.texture[lit], 90) > 0.4 * rendering.full_scale


def test_the_lower_half_of_the_plate_is_lit_twice() -> None:
    calibration, campaign = plate_and_mirror("mirror", "small", fringes=8)
    assert campaign.sequence.densities == tuple(range(8))
    sim = simulation(campaign, 0, "C1P1")
    shape, light = exact_shape(sim), trace(sim)
    assert shape.lit[shape.seen].all()
    low, high = (np.array(c)[:, None, None] for c in (calibration.volume.low, calibration.volume.high))
    assert ((shape.xyz > low) & (shape.xyz < high)).all(axis=0)[shape.seen].all()
    twice = light.strength[1, ::2, ::2] > 0.0
    height = shape.material[2]  # along the plate, both ways up the V
    upper, lower = (shape.seen & part for part in (height > 140.0, height < 100.0))
    assert not twice[upper].any()
    assert twice[lower].mean() > 0.75
    ratio = (light.strength[1] / np.maximum(light.strength[0], 1e-6))[::2, ::2][lower & twice]
    assert 0.15 < ratio.min() < ratio.max() < 0.6
    # In the mirror the camera sees the plate again, lit in both ways.
    assert (light.strength[0, ::2, ::2] > 0.0)[shape.region == 2].mean() > 0.7


def test_the_stringer_lifts_off_the_skin() -> None:
    _, campaign = PRINTED[NAMES.index("stringer")]
    truth = exact_truth(simulation(campaign, 0, "C1P1"), simulation(campaign, 4, "C1P1"))
    assert campaign.scene is not None
    out = np.einsum("i,irc->rc", campaign.scene.placement.matrix()[:, 2], truth.displacement)
    x, y, _ = truth.shape.material
    region, middle = truth.shape.region, np.abs(x) < 5.0
    beside = np.abs(np.abs(y) - 42.0) < 2.0
    lift = [out[middle & (region == r) & (np.abs(y) > 36.0)].mean() for r in (2, 3)]
    for side, sign in zip(lift, (1.0, -1.0), strict=True):
        skin = out[middle & (region == 1) & beside & (y * sign > 0.0)].mean()
        # 3 mm (1 +- 0.008 x 38); the skin is 4 mm farther out, where it bends by 24 x 160 / 600^2 = 0.011 mm
        # less, and the foot is up to 5 mm off the middle, f > 0.993 there.
        assert side - skin == pytest.approx(3.0 * (1.0 + sign * 0.008 * 38.0), abs=0.06)
    # Foot and web are wide enough to be seen; the sides of the web are not, since the baseline runs along it.
    seen = {r: int(((region == r) & truth.shape.lit).sum()) for r in range(1, 9)}
    assert min(seen[1], seen[2], seen[3]) > 10_000
    assert seen[4] > 2_000
    assert max(seen[5], seen[6]) < 0.1 * seen[2]


def test_the_wing_panel_is_seen_from_three_positions_that_overlap() -> None:
    ranges = []
    for (calibration, campaign), number in zip(wing_panel("wing", "small"), (1, 2, 3), strict=True):
        assert campaign.name == f"wing-{number}"
        shape = exact_shape(simulation(campaign, 0, "C1P1"))
        low, high = (np.array(c)[:, None, None] for c in (calibration.volume.low, calibration.volume.high))
        assert ((shape.xyz > low) & (shape.xyz < high)).all(axis=0)[shape.seen].all()
        ranges.append((np.nanmin(shape.material[0]), np.nanmax(shape.material[0])))
        assert np.ptp(shape.material[1][shape.seen]) > 174.0
    for (_, end), (start, _) in pairwise(sorted(ranges)):
        assert 100.0 < end - start < 180.0
    assert (min(r[0] for r in ranges), max(r[1] for r in ranges)) == pytest.approx((-330.0, 330.0), abs=20.0)


def test_the_translated_plate_has_the_states_of_the_thesis() -> None:
    _, campaign = PRINTED[NAMES.index("step")]
    shifts = [state.displacement_mm for state in campaign.states]
    assert len(shifts) == 18
    steps = np.diff(np.array(shifts, dtype=np.float64))
    np.testing.assert_allclose(steps, [0.127] * 8 + [1.016] * 9, rtol=1e-12)


def test_gauges_on_the_cracked_wing_panel_would_read_those_of_the_thesis() -> None:
    made = cracked_wing_panel("wing", "small")
    loads = [state.load_n for state in made[0][1].states[1:]]
    assert loads == [load_n for load_n, *_ in TABLE_5]
    places = np.array([(*place, 0.0) for place in GAUGES_MM])
    tips = []
    for state, (_, *strains) in zip(made[0][1].states[1:], TABLE_5, strict=True):
        crack = state.deformation[0]
        assert isinstance(crack, StringerCrack)
        tips.append(crack.tip_mm)
        slopes = gradients(packed_chain((crack,), AT_ORIGIN), places)[:, 0, 0] - 1.0
        # What the crack adds 100 mm, four fades, before its tip: 0.35 (1 + tanh -4) / 2 = 1.2e-4 of the
        # strain.
        np.testing.assert_allclose(slopes, strains, rtol=2e-4)
    assert (np.diff(tips) == -15.0).all()


def test_the_tie_rod_hides_and_shades_skin_foot_and_web() -> None:
    bare, whole = (
        exact_shape(simulation(PRINTED[NAMES.index(name)][1], 0, "C1P1")) for name in ("stringer", "buckling")
    )
    surface = PRINTED[NAMES.index("buckling")][1].scene.surface  # type: ignore[union-attr]
    assert isinstance(surface, StiffenedPanel)
    assert surface.rod is not None
    rod = 9 + 2 * len(surface.studs)
    assert int(((whole.region == rod) & whole.lit).sum()) > 2_000
    far = np.abs(bare.material[0]) > 60.0
    for part in (1, 2, 3, 4):
        seen = (bare.region == part) & bare.lit & far
        hidden = seen & (whole.region == rod)
        shaded = seen & (whole.region == part) & ~whole.lit
        assert hidden.any()
        # The rod is 12 mm thick, and so is its shadow: 12 mm of the 2 x 85 mm that are far, less what a
        # pixel cuts.
        assert 0.04 < shaded.sum() / seen.sum() < 0.12
    # Where nothing stands in the way the panel is seen as before.
    same = (bare.region == whole.region) & (bare.region > 0)
    np.testing.assert_array_equal(bare.xyz[:, same], whole.xyz[:, same])
    tops = [int(((whole.region == number) & whole.lit).sum()) for number in range(9, rod, 2)]
    # Discs of 6 and 9 mm radius in pixels of 0.65 mm: 268 and 602 px, foreshortened by 4 %.
    assert len(tops) == 8
    assert min(tops[:4]) > 200
    assert min(tops[4:]) > 450


def test_the_exact_mesh_is_that_of_the_deformation() -> None:
    _, campaign = PRINTED[NAMES.index("plate")]
    assert campaign.scene is not None
    mesh = exact_mesh(campaign, "S01", 4)
    material = transform(inverse(campaign.scene.placement), mesh.nodes)
    # Nodes lie on the plate, to rounding of 1000 mm, and move as its points do.
    np.testing.assert_allclose(material[:, 2], 0.0, atol=1e-9)
    ends = carried_points(packed_chain(campaign.states[1].deformation, campaign.scene.placement), material)
    np.testing.assert_allclose(mesh.displacement, ends - mesh.nodes, atol=1e-9)
    assert mesh.triangles.max() == len(mesh.nodes) - 1
    # 150 mm in steps of four pixels of 1.4 mm.
    assert len(mesh.nodes) == pytest.approx((150.0 / 5.6) ** 2, rel=0.1)
    with pytest.raises(InvalidInput, match="not measured in space on the virtual rig"):
        exact_mesh(replace(campaign, scene=None), "S01", 4)
