"""Run by the peers' environment in a folder that `sms bench peers` has prepared: match a pair with pyvale.

    python match_pyvale.py RASTER|MULTIWINDOW_RG

Reads `case.json` and `pair.npy`, (2, rows, columns); writes `pyvale.npz` with the points, their displacement
and whether they converged, and answers round by round with the CPU time from images to displacements.
"""

import json
import sys
from pathlib import Path

import numpy as np
from pyvale import dic
from rounds import answer


def main() -> None:
    """Match a pair again and again."""
    case = json.loads(Path("case.json").read_text())
    first, second = np.load("pair.npy")
    region = np.zeros(first.shape, bool)
    rim = case["rim_px"] - case["radius_px"] - 1
    region[rim:-rim, rim:-rim] = True
    out = Path(f"pyvale-{sys.argv[1]}")
    out.mkdir()

    def match() -> None:
        dic.calculate_2d(
            reference=first,
            deformed=second,
            roi_mask=region,
            seed=[first.shape[1] // 2, first.shape[0] // 2],
            subset_size=2 * case["radius_px"] + 1,
            subset_step=case["spacing_px"],
            shape_function="AFFINE",
            interpolation_routine="BSPLINE",
            precision=case["precision"],
            num_threads=1,
            max_displacement=case["search_px"],
            method=sys.argv[1],
            image_filter_kernel=1,
            output_basepath=out,
            output_below_threshold=True,
            print_level=0,
        )

    match()
    found = dic.import_2d(data=sorted(out.glob("dic_*")), delimiter=",", layout="column", print_level=0)
    np.savez(
        f"pyvale-{sys.argv[1]}.npz",
        x=found.ss_x,
        y=found.ss_y,
        displacement=np.stack([found.u_px[0], found.v_px[0]], axis=1),
        converged=found.converged[0],
        iterations=found.niter[0],
    )
    answer(match)


main()
