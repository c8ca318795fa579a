"""Run by the peers' environment in a folder that `sms bench peers` has prepared: match a pair with al-dic.

    python match_al_dic.py

Reads `case.json`, `pair.npy`, (2, rows, columns), and `points.npy`, (n, 2); writes `al_dic.npz` with the
displacement of the points and whether they converged, and answers round by round with the CPU time of its
local matching (IC-GN of six unknowns), from images to displacements.
"""

import json
from pathlib import Path

import numpy as np
from al_dic.core.config import dicpara_default
from al_dic.core.data_structures import GridxyROIRange
from al_dic.io.image_ops import compute_image_gradient, normalize_images
from al_dic.solver.local_icgn import local_icgn_precompute, local_icgn_solve_subset
from rounds import answer


def main() -> None:
    """Match a pair again and again."""
    case = json.loads(Path("case.json").read_text())
    pair = [image.astype(np.float64) for image in np.load("pair.npy")]
    points = np.load("points.npy").astype(np.float64)
    rows, columns = pair[0].shape
    whole = GridxyROIRange((0, columns - 1), (0, rows - 1))
    settings = dicpara_default(winsize=2 * case["radius_px"], tol=case["tolerance_px"], icgn_max_iter=20)
    guess = np.zeros(points.shape)

    def match():
        (first, second), _ = normalize_images(pair, whole)
        prepared = local_icgn_precompute(points, compute_image_gradient(first), first, settings)
        return local_icgn_solve_subset(prepared, None, guess, second, case["tolerance_px"])

    displacement, _, iterations = match()
    converged = iterations <= settings.icgn_max_iter
    np.savez("al_dic.npz", displacement=displacement, converged=converged, iterations=iterations)
    answer(match)


main()
