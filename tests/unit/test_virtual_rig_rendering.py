"""Rendered images: phases, light, edges, speckle, noise, and independence of order and threads."""

from __future__ import annotations

from dataclasses import replace
from math import pi

import numpy as np
import pytest
from support.sessions import small_session

from sms_jobs.instruments.simulated.rig import SimulatedRig
from sms_jobs.kinds.recording.simulate import scene_at
from sms_jobs.metrology.geometry.camera import Pose, pixel_grid, project, ray_directions
from sms_jobs.metrology.phase.patterns import phase_gradient
from sms_jobs.records.measurement import FringeSequence
from sms_jobs.records.scene import (
    CameraResponse,
    Plane,
    PlateAndMirror,
    ProjectorResponse,
    Rigid,
    Scene,
    Simulation,
    Speckle,
    Surface,
)
from sms_jobs.records.sensors import Rig, Sensor
from sms_jobs.virtual_rig.campaigns import CAMERA_LENS, PROJECTOR_LENS, START, Lens, aimed
from sms_jobs.virtual_rig.fringes import cosine_and_sine
from sms_jobs.virtual_rig.light import SUBSAMPLES, trace, trace_together
from sms_jobs.virtual_rig.rendering import SimulatedFrames, render
from sms_jobs.virtual_rig.speckle import packed_speckle, reflectance, speckle_of_cell
from sms_jobs.virtual_rig.truth import exact_shape

SIZE = 80
CAMERA = aimed("C1", SIZE, SIZE, CAMERA_LENS, (-500.0, 60.0, 2400.0), 0.05)
PROJECTOR = aimed("P1", 256, 192, PROJECTOR_LENS, (600.0, -50.0, 2300.0))
CLEAN = CameraResponse(bits=16, full_well=1e12, read_noise=0.0, ambient=0.0)
LINEAR = ProjectorResponse()
SEQUENCE = FringeSequence((8, 4), 4)


def simulation(
    surface: Surface,
    camera: CameraResponse = CLEAN,
    speckle: Speckle | None = None,
    sensors: tuple[Sensor, ...] = (CAMERA, PROJECTOR),
    projector: ProjectorResponse = LINEAR,
) -> Simulation:
    return Simulation(
        Scene(Rig("rig", sensors), surface, speckle, camera=camera, projector=projector), "C1", "P1", ()
    )


def test_phase_stepping_recovers_the_phase_of_the_truth() -> None:
    # A plate that fills the image, so that no pixel mixes.
    sim = simulation(Plane(1200.0, 1200.0), sensors=(CAMERA, aimed_wide()))
    frames = render(sim, SEQUENCE).frames
    shape = exact_shape(sim)
    projector = sim.scene.rig.sensors[1]
    pixels = project(projector.intrinsics, projector.pose, np.moveaxis(shape.xyz, 0, -1))
    inner = (slice(4, -4), slice(4, -4))
    light = np.gradient(np.log(render(sim, SEQUENCE).texture.astype(float)))
    for group, (orientation, density) in enumerate([(0.0, 8), (0.0, 4), (pi / 2, 8), (pi / 2, 4)]):
        i = [frames.frame(4 * group + k).astype(float) for k in range(4)]
        phase = np.arctan2(i[3] - i[1], i[0] - i[2])
        omega = phase_gradient(pixels, projector.columns, projector.rows, orientation)
        error = np.angle(np.exp(1j * (phase - density * omega)))
        # A pixel averages over its blur and its sub-samples, of variance 1/4 + 1/16 px^2: where the light
        # changes across the pixel, and where the phase is curved, that shifts the phase to first order by
        slope = np.gradient(density * omega)
        curved = np.gradient(slope[0], axis=0) + np.gradient(slope[1], axis=1)
        shift = 0.3125 * (slope[0] * light[0] + slope[1] * light[1] + 0.5 * curved)
        # Rounding to whole levels adds 0.29 sqrt(2) / 32000 = 1.3e-5 rad; five of those.
        assert np.abs(error - shift)[inner].max() < 7e-5
        assert np.abs(shift[inner]).max() < 5e-4
        # On the rim the light beyond is guessed, right to the first order: an error like that shift, of the
        # second. To repeat the last ray would take the phase a fifth of a pixel inwards.
        assert np.abs(error).max() < 1e-3 < 0.1 * np.hypot(*slope).min()


def aimed_wide() -> Sensor:
    return aimed("P1", 256, 192, Lens(1.6, -0.05, 0.08, -4e-4, 2e-4), (600.0, -50.0, 2300.0))


def test_grey_level_of_a_facing_white_surface_is_the_exposure() -> None:
    # Camera and projector side by side, in front of a plate at the distance that sets the scale.
    sensors = (
        aimed("C1", 32, 32, CAMERA_LENS, (0.0, 0.0, 2000.0)),
        aimed("P1", 64, 64, PROJECTOR_LENS, (1.0, 0.0, 2000.0)),
    )
    rendering = render(simulation(Plane(900.0, 900.0), sensors=sensors), SEQUENCE)
    middle = rendering.texture[12:20, 12:20] / rendering.full_scale
    # Within 4 x sqrt(2) pixels of 16 mm of the axis, cosine and distance take 3/2 (92 / 2000)^2 at most.
    np.testing.assert_allclose(middle, 0.8, rtol=3.5e-3)


def test_ambient_light_is_added_without_fringes() -> None:
    lit = replace(CLEAN, ambient=0.1)
    dark, bright = (render(simulation(Plane(400.0, 400.0), c), SEQUENCE) for c in (CLEAN, lit))
    extra = bright.texture.astype(int) - dark.texture
    middle = slice(30, 50)
    # One level of rounding on each side.
    np.testing.assert_allclose(extra[middle, middle], 0.1 * 0.8 * 65535, atol=2)
    fringes = [r.frames.frame(0).astype(int) - r.frames.frame(2) for r in (dark, bright)]
    np.testing.assert_allclose(fringes[0][middle, middle], fringes[1][middle, middle], atol=4)


def test_an_edge_pixel_shows_the_share_of_the_plate_in_it() -> None:
    # A plate's edge crosses the image: summed across it, the light is the plate's width in pixels.
    sensors = (
        aimed("C1", 64, 64, Lens(4.0, 0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 2000.0), 0.21),
        aimed("P1", 64, 64, Lens(1.5, 0.0, 0.0, 0.0, 0.0), (1.0, 0.0, 2000.0)),
    )
    for width in (150.0, 151.3, 154.9):
        sharp = replace(CLEAN, blur_px=0.0)
        texture = render(simulation(Plane(width, width), sharp, sensors=sensors), SEQUENCE).texture
        area = texture.sum() / np.median(texture[24:40, 24:40])
        expected = (width / 2000.0 * 4.0 * 64.0) ** 2 * 1.001
        # An edge of 20 px in 2 x 2 sub-samples errs by about 0.25 / sqrt(12) px a pixel, at random:
        # sqrt(4 x 20) x 0.07 = 0.7 px^2. Light falls off to the corners by 2 (75 / 2000)^2 = 0.3 %: 1 px^2.
        assert area == pytest.approx(expected, abs=3.0)


def test_blur_spreads_light_and_keeps_its_sum() -> None:
    plate = Plane(200.0, 200.0)
    sharp, soft = (
        render(simulation(plate, replace(CLEAN, blur_px=b)), SEQUENCE).texture.astype(float)
        for b in (0.0, 1.5)
    )
    # The plate ends far from the image's edge; rounding averages out.
    assert soft.sum() == pytest.approx(sharp.sum(), rel=1e-4)
    # Across a straight edge the variance of the line spread grows by blur^2 (sampled Gaussian: to 1 %).
    row = SIZE // 2
    spreads = []
    for image in (sharp, soft):
        edge = np.diff(image[row, : SIZE // 2])
        x = np.arange(edge.size)
        mean = (edge * x).sum() / edge.sum()
        spreads.append((edge * (x - mean) ** 2).sum() / edge.sum())
    assert spreads[1] - spreads[0] == pytest.approx(1.5**2, rel=0.03)


def test_speckles_have_their_diameter_and_move_with_the_material() -> None:
    pattern = packed_speckle(Speckle(6.0, seed=3))
    radii = [speckle_of_cell(pattern, i, j)[2] for i in range(-30, 30) for j in range(-30, 30)]
    # Spread evenly over +-20 %: standard deviation 0.35 mm a radius / sqrt(3600) = 0.006 mm.
    assert np.mean(radii) == pytest.approx(3.0, abs=0.03)
    assert 2.4 <= min(radii) <= max(radii) <= 3.6
    # A shift of a whole number of pixels on the plate shifts the picture by as much.
    lens = Lens(4.0, 0.0, 0.0, 0.0, 0.0)
    sensors = (
        aimed("C1", 64, 64, lens, (0.0, 0.0, 2000.0)),
        aimed("P1", 64, 64, Lens(1.5, 0.0, 0.0, 0.0, 0.0), (1.0, 0.0, 2000.0)),
    )
    start = simulation(Plane(700.0, 700.0), speckle=Speckle(50.0), sensors=sensors)
    pitch = 2000.0 / (4.0 * 64.0)
    moved = replace(start, deformation=(Rigid(translation_mm=(5 * pitch, 0.0, 0.0)),))
    before, after = (render(s, SEQUENCE).texture[4:-4].astype(float) for s in (start, moved))
    # Light falls off with the square of the distance to the axis: 3 % at most from one place to the other.
    np.testing.assert_allclose(after[:, 10:-5], before[:, 5:-10], rtol=0.04)
    assert before.max() > 2.0 * before.min()


def test_speckle_is_averaged_over_its_footprint() -> None:
    # Against brute force: the mean of the sharp pattern over a square as large as the footprint.
    pattern = packed_speckle(Speckle(5.0, dark=0.0, bright=1.0, seed=11))
    footprint, fine = 0.5, 40
    offsets = ((np.arange(fine) + 0.5) / fine - 0.5) * footprint
    rng = np.random.default_rng(5)
    errors = []
    for a, b in rng.uniform(-100.0, 100.0, (200, 2)):
        brute = np.mean([[reflectance(pattern, a + x, b + y, 1e-9) for x in offsets] for y in offsets])
        errors.append(reflectance(pattern, a, b, footprint) - brute)
    # Where two speckles meet in one footprint their shares are taken as independent, which is wrong by a
    # quarter at most and rare. Elsewhere the brute-force mean is no better than 1 / 80: half of a sample
    # line; the former linear fall was off by up to 0.09 there.
    assert np.abs(errors).max() < 0.25
    assert np.quantile(np.abs(errors), 0.98) < 0.0125
    assert np.sqrt(np.mean(np.square(errors))) < 0.006
    assert abs(np.mean(errors)) < 0.001


def test_defocus_and_gamma_change_the_fringes_as_the_pattern_says() -> None:
    plate = Plane(1200.0, 1200.0)
    sensors = (CAMERA, aimed_wide())
    middle = slice(30, 50)

    def modulation(response: ProjectorResponse) -> float:
        frames = render(simulation(plate, sensors=sensors, projector=response), SEQUENCE).frames
        i = [frames.frame(k)[middle, middle].astype(float) for k in range(4)]
        return float(np.mean(np.hypot(i[3] - i[1], i[0] - i[2])))

    sharp = modulation(ProjectorResponse())
    assert modulation(ProjectorResponse(visibility=0.6)) == pytest.approx(0.6 * sharp, rel=1e-3)
    mtf = np.exp(-2.0 * (pi * 2.0 * 8 / 256) ** 2)
    assert modulation(ProjectorResponse(defocus_px=2.0)) == pytest.approx(mtf * sharp, rel=1e-3)
    frames = render(simulation(plate, sensors=sensors, projector=ProjectorResponse(gamma=2.2)), SEQUENCE)
    white = frames.texture[middle, middle]
    phase = np.arccos(2.0 * frames.frames.frame(4)[middle, middle] / white - 1.0)
    assert np.isfinite(phase).all()
    # Opposite steps of a raised cosine add up to white; a gamma takes light away everywhere but at the ends.
    total = frames.frames.frame(4)[middle, middle].astype(float) + frames.frames.frame(6)[middle, middle]
    assert np.mean(total / white) < 0.9


def test_the_density_zero_is_a_bright_and_a_dark_field() -> None:
    sequence = FringeSequence((0, 2), 4, (0.0, pi / 2))
    rendering = render(simulation(Plane(1200.0, 1200.0), sensors=(CAMERA, aimed_wide())), sequence)
    frames = rendering.frames.rows(0, SIZE).astype(int)
    assert len(frames) == sequence.frames == 2 * (2 + 4)
    for bright, dark, fringes in ((frames[0], frames[1], frames[2:6]), (frames[6], frames[7], frames[8:])):
        # The brightest field is the texture; rounding is half a grey level of each.
        assert np.abs(bright - rendering.texture.astype(int)).max() <= 1
        assert dark.max() <= 1
        # Its amplitude is that of the fringes: 2 B = bright - dark; four frames are rounded, and thousands of
        # grey levels are blurred over the fringes by 1e-3.
        amplitude = np.hypot(fringes[0] - fringes[2], fringes[3] - fringes[1])
        np.testing.assert_allclose(amplitude[4:-4, 4:-4], (bright - dark)[4:-4, 4:-4], rtol=2e-3, atol=2.0)


def test_a_mirror_gives_a_second_return_from_the_projectors_image() -> None:
    surface = PlateAndMirror(260.0, 300.0, 1.5, 0.4, 200.0)
    sim = simulation(surface, sensors=(CAMERA, aimed_wide()))
    projector = sim.scene.rig.sensors[1]
    light = trace(sim)
    tilt = (pi - 1.5) / 2.0
    normal = np.array([-np.sin(tilt), 0.0, np.cos(tilt)])
    plate_normal = np.array([np.sin(tilt), 0.0, np.cos(tilt)])
    eye, source = CAMERA.pose.centre(), projector.pose.centre()
    image = source - 2.0 * (source @ normal) * normal
    pixels = (pixel_grid(*light.ambient.shape) + 0.5) / SUBSAMPLES - 0.5
    rays = ray_directions(CAMERA.intrinsics, CAMERA.pose, pixels)
    both = np.argwhere((light.strength[0] > 0) & (light.strength[1] > 0))
    checked = direct = 0
    for i, j in both[:: max(len(both) // 200, 1)]:
        ray = rays[i, j]
        start, factor = eye, 1.0
        on_plate = eye - ray * (eye @ plate_normal) / (ray @ plate_normal)
        if on_plate[0] > 0.0:  # the camera looks into the mirror
            start, factor = eye - ray * (eye @ normal) / (ray @ normal), 0.4
            ray = ray - 2.0 * (ray @ normal) * normal
            on_plate = start - ray * (start @ plate_normal) / (ray @ plate_normal)
        else:
            direct += 1
        there, here = image - on_plate, source - on_plate
        meets = on_plate - there * (on_plate @ normal) / (there @ normal)
        xy = [project(projector.intrinsics, projector.pose, p) for p in (on_plate, meets)]
        for k in range(2):
            np.testing.assert_allclose([light.x[k, i, j], light.y[k, i, j]], xy[k], atol=1e-8)

        def shine(way: np.ndarray) -> float:
            return float(way @ plate_normal / np.linalg.norm(way) ** 3)

        # Strengths are stored in single precision.
        ratio = light.strength[1, i, j] / light.strength[0, i, j]
        assert ratio == pytest.approx(0.4 * shine(there) / shine(here), rel=1e-6)
        scale = np.linalg.norm(source) ** 2
        assert light.strength[0, i, j] == pytest.approx(factor * shine(here) * scale, rel=1e-6)
        checked += 1
    assert checked > 100
    assert 0 < direct < checked  # both ways of seeing the plate were met


NOISY = CameraResponse(bits=12, full_well=8_000.0, read_noise=12.0)


def test_noise_has_the_variance_that_the_measurement_states() -> None:
    sim = simulation(Plane(1200.0, 1200.0), NOISY, sensors=(CAMERA, aimed_wide()))
    rendering = render(sim, SEQUENCE)
    frames = rendering.frames
    levels = np.concatenate([frames.expected(i).ravel() for i in range(16)])
    noise = np.concatenate([frames.frame(i).ravel() for i in range(16)]) - levels
    bright = levels > 200.0  # so far above zero that nothing is cut off
    variance = rendering.read_noise**2 + rendering.gain * levels
    for low, high in [(200.0, 800.0), (800.0, 1500.0), (1500.0, 3000.0)]:
        part = bright & (levels >= low) & (levels < high)
        score = noise[part] ** 2 / variance[part]
        # The mean of n squared normal numbers scatters by sqrt(2 / n); five of those.
        assert np.mean(score) == pytest.approx(1.0, abs=5.0 * np.sqrt(2.0 / part.sum()))
        mean = noise[part] / np.sqrt(variance[part])
        assert abs(np.mean(mean)) < 5.0 / np.sqrt(part.sum())
    assert rendering.full_scale == 4095
    assert rendering.gain == pytest.approx(4095 / 8000)


def test_noise_of_frames_pairs_and_states_is_independent() -> None:
    sim = simulation(Plane(1200.0, 1200.0), NOISY, sensors=(CAMERA, aimed_wide()))
    first = render(sim, SEQUENCE).frames
    other = render(replace(sim, state="S01"), SEQUENCE).frames
    a = first.frame(0) - first.expected(0)
    for b in (first.frame(1) - first.expected(1), other.frame(0) - other.expected(0), a[::-1]):
        # A correlation of n independent views scatters by 1 / sqrt(n).
        assert abs(np.corrcoef(a.ravel(), b.ravel())[0, 1]) < 5.0 / SIZE


@pytest.mark.parametrize("bits", [8, 12, 16])
def test_levels_are_whole_and_end_at_full_scale(bits: int) -> None:
    response = replace(NOISY, bits=bits, exposure=1.6)
    rendering = render(simulation(Plane(300.0, 300.0), response), SEQUENCE)
    assert rendering.texture.dtype == rendering.frames.frame(0).dtype == np.uint16
    assert rendering.full_scale == 2**bits - 1
    assert rendering.texture.max() == rendering.full_scale
    assert np.mean(rendering.texture == rendering.full_scale) > 0.1
    assert rendering.texture.min() == 0


def test_a_frame_is_the_same_in_any_order_on_any_threads_and_in_rows() -> None:
    sim = simulation(Plane(300.0, 300.0), NOISY, Speckle(20.0))
    one, two = (render(sim, SEQUENCE, threads=n) for n in (1, 2))
    np.testing.assert_array_equal(one.texture, two.texture)
    forward = np.stack([one.frames.frame(i) for i in range(SEQUENCE.frames)])
    backward = np.stack([two.frames.frame(i) for i in reversed(range(SEQUENCE.frames))])[::-1]
    np.testing.assert_array_equal(forward, backward)
    assert one.frames.shape == forward.shape == (16, SIZE, SIZE)
    np.testing.assert_array_equal(one.frames.frame(-1), forward[-1])
    with pytest.raises(IndexError):
        one.frames.frame(16)
    for start, stop in [(0, SIZE), (3, 17), (60, 70), (64, 80)]:
        np.testing.assert_array_equal(one.frames.rows(start, stop), forward[:, start:stop])


def test_projectors_that_are_traced_together_give_what_each_gives_alone() -> None:
    third = replace(aimed_wide(), name="P2")
    sim = simulation(Plane(300.0, 300.0), NOISY, Speckle(20.0), sensors=(CAMERA, PROJECTOR, third))
    both = [sim, replace(sim, projector="P2")]
    for light, one in zip(trace_together(both), both, strict=True):
        alone = trace(one)
        for name in ("x", "y", "strength", "ambient", "windows"):
            np.testing.assert_array_equal(getattr(light, name), getattr(alone, name))
        assert (light.strength > 0.0).any()
    rig = SimulatedRig(sim.scene, sim.state, sim.deformation, START, views=("C1P1", "C1P2"))
    for view, one in zip(("C1P2", "C1P1"), reversed(both), strict=True):
        recorded, rendering = rig.record(view, SEQUENCE), render(one, SEQUENCE)
        np.testing.assert_array_equal(recorded.texture, rendering.texture)
        np.testing.assert_array_equal(recorded.frames.frame(5), rendering.frames.frame(5))


def bar_before_the_rig() -> Simulation:
    campaign = small_session("bar")
    state = campaign.states[-1]
    assert campaign.scene is not None
    return Simulation(scene_at(campaign.scene, campaign, state), "C1", "P1", state.deformation, state.label)


@pytest.mark.parametrize("shown", ["bar", "plate", "nothing"])
def test_what_lies_beyond_the_windows_is_as_if_it_had_been_looked_at(shown: str) -> None:
    sim, count = bar_before_the_rig(), 2
    if shown != "bar":
        sim, count = simulation(Plane(200.0, 150.0), NOISY, Speckle(20.0)), 1
    if shown == "nothing":
        sim, count = replace(sim, deformation=(Rigid((0.0, 0.0, 0.0), (5000.0, 0.0, 0.0)),)), 0
    light = trace(sim)
    _, rows, columns = light.strength.shape
    whole = replace(light, windows=np.array([[0, rows // SUBSAMPLES, 0, columns // SUBSAMPLES]]))
    assert len(light.windows) == count
    windowed, everywhere = (SimulatedFrames(sim, SEQUENCE, seen, 1) for seen in (light, whole))
    for index in (0, 5):
        np.testing.assert_array_equal(windowed.expected(index), everywhere.expected(index))
        np.testing.assert_array_equal(windowed.frame(index), everywhere.frame(index))
    some = rows // (2 * SUBSAMPLES) - 20, rows // (2 * SUBSAMPLES) + 20
    np.testing.assert_array_equal(windowed.rows(*some), everywhere.rows(*some))
    assert (0.01 if count else -1.0) < np.mean(windowed.expected(0) > 1.0) < 0.5


def test_cosine_and_sine_are_right_to_rounding() -> None:
    for turns in [*np.linspace(-40.0, 40.0, 2003).tolist(), *(np.arange(-16, 17) / 8.0).tolist()]:
        cosine, sine = cosine_and_sine.py_func(turns)  # type: ignore[attr-defined]
        # Whole turns are taken off without rounding; what is left is rounded once, and so are its functions.
        angle = 2.0 * pi * (turns - round(turns))
        assert cosine == pytest.approx(np.cos(angle), abs=2.0**-50)
        assert sine == pytest.approx(np.sin(angle), abs=2.0**-50)


def test_shadow_gets_ambient_light_only() -> None:
    behind = aimed("P1", 256, 192, PROJECTOR_LENS, (0.0, 0.0, -2300.0))
    lit = replace(CLEAN, ambient=0.05)
    sim = simulation(Plane(400.0, 400.0), lit, sensors=(CAMERA, behind))
    texture = render(sim, SEQUENCE).texture
    assert texture[40, 40] == round(0.05 * 0.8 * 65535)
    assert not exact_shape(sim).lit.any()


def test_placing_specimen_and_sensors_together_changes_nothing() -> None:
    turn = Pose.looking_at(np.array([0.3, 0.2, -1.0]), np.zeros(3), np.array([0.1, -1.0, 0.0])).matrix()
    shift = np.array([100.0, -50.0, 30.0])

    def moved(sensor: Sensor) -> Sensor:
        rotation = sensor.pose.matrix() @ turn.T
        return replace(
            sensor,
            pose=Pose.from_arrays(rotation, np.array(sensor.pose.translation) - rotation @ shift),
        )

    here = simulation(Plane(300.0, 300.0), speckle=Speckle(25.0))
    scene = here.scene
    there = replace(
        here,
        scene=replace(
            scene,
            rig=replace(scene.rig, sensors=tuple(moved(s) for s in scene.rig.sensors)),
            placement=Pose.from_arrays(turn, shift),
        ),
    )
    before, after = (render(s, SEQUENCE) for s in (here, there))
    # Rounding moves a ray by 1e-12 mm; a level of 65535 may fall on the other side.
    np.testing.assert_allclose(before.texture.astype(int), after.texture.astype(int), atol=1)
