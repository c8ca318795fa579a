"""Green-Lagrange strain does not see rigid motions, whatever they are and wherever the gauge is."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sms_jobs.metrology.deformation.strain.tangent_plane import surface_strain

ANGLE = st.floats(-3.0, 3.0)


@settings(max_examples=25)
@given(
    turn=st.tuples(ANGLE, ANGLE, ANGLE),
    bend=st.floats(-0.02, 0.02),
    stretch=st.floats(-0.2, 0.2),
    azimuth=st.floats(0.0, 6.28),
)
def test_strain_is_that_before_any_rigid_motion(
    turn: tuple[float, float, float], bend: float, stretch: float, azimuth: float
) -> None:
    row, column = np.mgrid[0:24, 0:24].astype(np.float64)
    x, y = column - 12.0, 12.0 - row
    xyz = np.stack([x, y, bend * x**2 + 0.5 * bend * x * y])
    axis = (float(np.cos(azimuth)), float(np.sin(azimuth)), 0.0)
    grown = np.stack([stretch * x, np.zeros_like(x), np.zeros_like(x)])
    rotation = Rotation.from_rotvec(turn).as_matrix()
    after = np.einsum("ij,jrc->irc", rotation, xyz + grown) + np.array([50.0, -30.0, 8.0])[:, None, None]
    labels, none = np.ones((24, 24), np.int32), np.zeros((6, 24, 24))
    still = surface_strain(xyz, grown, none, labels, gauge_length=7.0, x_axis=axis)
    moved = surface_strain(xyz, after - xyz, none, labels, gauge_length=7.0, x_axis=axis)
    # Rounding of displacements of 100 mm over a disc of 7 mm.
    np.testing.assert_allclose(moved.strain, still.strain, atol=1e-11)
    np.testing.assert_allclose(
        moved.principal[0] + moved.principal[1], moved.strain[0] + moved.strain[1], atol=1e-11
    )
    assert (moved.principal[0] >= moved.principal[1]).all()
