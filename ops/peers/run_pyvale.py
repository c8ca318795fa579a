"""Run by the peers' environment in a folder that `sms bench stereo` has prepared: measure it with pyvale.

    python run_pyvale.py

Reads `case.json` and the images beside it; writes `pyvale.npz` with the pixels, the points at rest, their
displacement at each other state (states, 3, n) in mm in the first camera's frame, and the CPU time without
loading the program.
"""

import json
import time
from pathlib import Path

import numpy as np
from PIL import Image
from pyvale import calib, dic
from scipy.spatial.transform import Rotation


def camera(matrix, distortion):
    """Return a camera's parameters as pyvale has them."""
    (fx, skew, cx), (_, fy, cy), _ = matrix
    return calib.CamIntrinsics(fx=fx, fy=fy, fs=skew, cx=cx, cy=cy, distortion=np.array(distortion))


def main() -> None:
    """Measure all states, once."""
    case = json.loads(Path("case.json").read_text())
    turn = Rotation.from_matrix(case["rotation"]).as_euler("xyz", degrees=True)
    rig = calib.Calib(
        cam0=camera(case["matrices"][0], case["distortions"][0]),
        cam1=camera(case["matrices"][1], case["distortions"][1]),
        translation=np.array(case["translation"]),
        rotation=turn,
    )
    out = Path("pyvale")
    out.mkdir(exist_ok=True)
    used = time.process_time()
    dic.calculate_3d(
        reference=[Path("0_0.tiff"), Path("1_0.tiff")],
        deformed=[
            [Path(f"{camera}_{state}.tiff") for state in range(1, case["states"])] for camera in (0, 1)
        ],
        roi_mask=np.array(Image.open("roi.png")) > 0,
        calibration=rig,
        seed=case["seed"],
        subset_size=case["subset_px"],
        subset_step=case["spacing_px"],
        max_displacement=case["search_px"],
        num_threads=1,
        output_basepath=out,
        print_level=0,
    )
    used = time.process_time() - used
    found = dic.import_3d(
        data=sorted(out.glob("dic_results_*")), delimiter=",", layout="column", print_level=0
    )
    points = found.stereo
    np.savez(
        "pyvale.npz",
        pixels=np.stack([found.ss_x, found.ss_y]),
        points=np.stack([points.x_mm, points.y_mm, points.z_mm]),
        displacement=np.stack([points.u_mm, points.v_mm, points.w_mm], axis=1)[1:],
        cpu_s=used,
        spacing_px=case["spacing_px"],
    )


main()
