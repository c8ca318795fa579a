"""Whether the residuals of a sensor's boards are those of a lens that bends otherwise than its model can."""

from __future__ import annotations

import numpy as np

from sms_jobs.metrology.arrays import Floats
from sms_jobs.metrology.calibration.bundle.normal_equations import Live, Observed, Packed
from sms_jobs.metrology.calibration.bundle.parameters import Freedom
from sms_jobs.metrology.calibration.bundle.problem import BundleProblem
from sms_jobs.metrology.geometry.camera import PER_SENSOR, SENSOR_PARAMETERS
from sms_jobs.metrology.geometry.lens import foreign
from sms_jobs.metrology.small_systems import inverse

_NEXT = ("k3", "k4")
"""Radial terms in the order in which a lens is asked for them."""


def missing_radial(
    problem: BundleProblem,
    packed: Packed,
    live: Live,
    freedom: Freedom,
    equations: tuple[Floats, Floats],
    observed: Observed,
    scale: Floats,
) -> dict[str, float]:
    """Return the share of squared board residuals that one radial term more would take, by sensor.

    Parameters
    ----------
    problem, packed, live, freedom, observed, scale
        Of the adjustment, at its minimum.
    equations
        Normal matrix and gradient of all parameters, free or not.

    Returns
    -------
    For every plain lens that saw boards and has a radial term held. One step of Newton's method lowers the
    squares by g^T N^-1 g (Rao's score), so that nothing is adjusted again.
    """
    squares = np.zeros(len(problem.sensors))
    for block in packed.boards:
        part = slice(block.start, block.stop)
        white = observed.board_found[part] / scale[3 if block.projector else 2]
        own = observed.board_found[part, 4] * np.sum(white[:, 2:4] ** 2, axis=1)
        squares[block.sensors[0]] += float(np.sum(own[live.board[part]]))
    shares = {}
    for number, sensor in enumerate(problem.sensors):
        if squares[number] == 0.0 or not set(foreign("plain")) <= set(sensor.fixed):
            continue
        places = [PER_SENSOR * number + SENSOR_PARAMETERS.index(name) for name in _NEXT]
        wanted = next((place for place in places if not freedom.free[place]), None)
        if wanted is None or sensor.intrinsics.model != "plain":
            continue
        more = freedom.free.copy()
        more[wanted] = True
        normal, gradient = Freedom(more, freedom.followers).fold(*equations)
        found = inverse(normal)
        if found is not None:
            shares[sensor.name] = float(gradient @ found @ gradient / squares[number])
    return shares
