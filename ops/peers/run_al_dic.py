"""Run by the peers' environment in a folder that `sms bench stereo` has prepared: measure it with al-dic-3d.

    python run_al_dic.py

Reads `case.json` and the images beside it; writes `al_dic.npz` with the pixels, the points at rest, their
displacement at each other state (states, 3, n) in mm in the first camera's frame, and the CPU time without
loading and compiling. Its grid has a spacing that is a power of two, the next above what is asked for.
"""

import json
import time
from pathlib import Path

import cv2
import numpy as np
from al_dic_3d.runner import load_config, run_pipeline
from PIL import Image

CONFIG = """
[calibration]
file = "calibration.yml"
format = "opencv_yaml"
[sequence]
left = {left}
right = {right}
[roi]
mask = "{mask}"
[matching]
winsize = {winsize}
winstepsize = {spacing}
winsize_min = {spacing}
fft_search = {search}
disparity_offset = {disparity}
init_guess = "fft"
[output]
dir = "al_dic"
"""


def main() -> None:
    """Measure all states twice; the first time compiles."""
    case = json.loads(Path("case.json").read_text())
    spacing = 1 << (case["spacing_px"] - 1).bit_length()
    file = cv2.FileStorage("calibration.yml", cv2.FILE_STORAGE_WRITE)
    for number in (0, 1):
        file.write(f"cameraMatrix{number + 1}", np.array(case["matrices"][number]))
        file.write(f"distCoeffs{number + 1}", np.array(case["distortions"][number]))
    file.write("R", np.array(case["rotation"]))
    file.write("T", np.array(case["translation"]).reshape(3, 1))
    file.release()
    # A corner of the region compiles all that the whole of it needs.
    region = np.array(Image.open("roi.png"))
    top, left = np.argwhere(region)[len(np.argwhere(region)) // 3]
    corner = np.zeros_like(region)
    corner[top : top + 200, left : left + 200] = region[top : top + 200, left : left + 200]
    Image.fromarray(corner).save("corner.png")
    cv2.setNumThreads(1)
    for mask in ("corner.png", "roi.png"):
        left, right = ([f"{camera}_{state}.tiff" for state in range(case["states"])] for camera in (0, 1))
        text = CONFIG.format(
            left=json.dumps(left),
            right=json.dumps(right),
            winsize=case["subset_px"] - 1,
            spacing=spacing,
            search=case["search_px"],
            disparity=case["disparity_px"],
            mask=mask,
        )
        Path("config.toml").write_text(text)
        started = time.process_time()
        result = run_pipeline(load_config("config.toml"))
        used = time.process_time() - started
    found = result.reconstruction
    np.savez(
        "al_dic.npz",
        pixels=result.ref_coords.T,
        points=found.points[0].T,
        displacement=np.moveaxis(found.displacement[1:], 2, 1),
        cpu_s=used,
        spacing_px=spacing,
    )


main()
