"""Run by the peers' environment in a folder that `sms bench witness` has prepared: render with riley.

    python render_speckles.py

Reads `case.json` (cameras with OpenCV's parameters, the states) and `sheets.npz` (meshes of the specimen at
each state, quadrilaterals of nine nodes, with their paint and the light that falls on each node); writes
`STATE.npz` with the light of each camera's pixels, `C1` and `C2`, and at the first state `hits.npz` with
what the rays through the pixels' centres of the first camera meet: number of the sheet, -1 for none, and
place in it.

Meshes are brought into the camera's frame here, and the principal point off the image's middle by rendering a
larger image and cutting: riley has its camera look at the middle of its image.
"""

import json
from pathlib import Path

import numpy as np
import riley
from pixels import FINE, pixels

NOTHING = -1.0


def camera(told, fine, rays):
    """Return a camera at the origin with so many pixels a pixel, and how its image is cut to size."""
    matrix = np.array(told["matrix"])
    size = np.array([told["columns"], told["rows"]])
    beside = matrix[:2, 2] - (size - 1) / 2
    larger = np.rint(fine * (size + 2 * np.abs(beside))).astype(int)
    k1, k2, p1, p2, k3 = told["distortion"]
    made = riley.Camera(
        pixels_num=tuple(larger.tolist()),
        pixels_size=(1.0 / (fine * matrix[0, 0]), 1.0 / (fine * matrix[1, 1])),
        pos_world=(0.0, 0.0, 0.0),
        rot_world=(0.0, 0.0, 0.0),
        roi_cent_world=(0.0, 0.0, -1.0),
        focal_length=1.0,
        sub_sample=rays,
        distort_model=1,
        distort_k1=k1,
        distort_k2=k2,
        distort_k3=k3,
        distort_p1=p1,
        distort_p2=p2,
        coord_sys=riley.CameraCoordSys.opengl,
        psf_type=riley.PsfType.pixel_box,
    )
    start = np.where(beside < 0, larger - fine * size, 0)
    return made, tuple(slice(a, a + fine * n) for a, n in zip(start[::-1], size[::-1], strict=True))


def seen_by(told, place):
    """Return nodes (m, n, 3) in the frame of a camera that looks along -z, as OpenGL has it, (m n, 3)."""
    own = place.reshape(-1, 3) @ np.array(told["rotation"]).T + np.array(told["translation"])
    return own * [1.0, -1.0, -1.0]


def elements(m, n):
    """Return the quadrilaterals of nine nodes of a raster of nodes: corners, sides, middle."""
    number = np.arange(m * n).reshape(m, n)
    at = [(0, 0), (2, 0), (2, 2), (0, 2), (1, 0), (2, 1), (1, 2), (0, 1), (1, 1)]
    return np.stack([number[i : m - 2 + i : 2, j : n - 2 + j : 2].ravel() for i, j in at], axis=1)


def rendered(told, meshes, fine, rays):
    """Return an image of meshes, (fine * rows, fine * columns), of so many squared rays a pixel of it."""
    made, cut = camera(told, fine, rays)
    config = riley.RasterConfig(
        parallel=1,
        save_strategy=riley.SaveStrategy.memory,
        background_value=NOTHING,
        report=riley.ReportMode.off,
    )
    return riley.raster(meshes, made, config).reshape(made.pixels_num[::-1])[cut]


def main():
    """Render all states."""
    case = json.loads(Path("case.json").read_text())
    told = np.load("sheets.npz")

    def meshes(state, sensor, shader):
        return [
            riley.Mesh(
                mesh_type=riley.MeshType.quad9,
                coords=seen_by(sensor, told[f"{state}_{k}"]),
                connect=elements(*told[f"{state}_{k}"].shape[:2]).astype(np.uintp),
                disp=None,
                shader=shader(k),
            )
            for k in range(case["sheets"])
        ]

    def places(k):
        m, n = told[f"{start}_{k}"].shape[:2]
        u, v = np.meshgrid(np.linspace(0, 1, m), np.linspace(0, 1, n), indexing="ij")
        return np.stack([u.ravel(), v.ravel()], axis=1)

    def field(values):
        none = riley.ScaleStrategy.none
        return riley.NodalShader(field=np.ascontiguousarray(values).reshape(1, -1, 1), scaling_type=none)

    def painted(k):
        return riley.TextureShader(
            uvs=places(k),
            texture=np.ascontiguousarray(told[f"paint_{k}"])[None],
            sample=riley.TextureSample.linear,
            scaling_type=riley.ScaleStrategy.none,
        )

    first = case["cameras"]["C1"]
    start = case["states"][0]
    number = rendered(first, meshes(start, first, lambda k: field(np.full(len(places(k)), float(k)))), 1, 1)
    place = [
        rendered(first, meshes(start, first, lambda k, i=i: field(places(k)[:, i])), 1, 1) for i in (0, 1)
    ]
    np.savez("hits.npz", number=np.rint(number).astype(int), place=np.stack(place))
    for state in case["states"]:
        found = {}
        for name, sensor in case["cameras"].items():
            paint = rendered(sensor, meshes(state, sensor, painted), FINE, case["rays"])
            lit = rendered(
                sensor, meshes(state, sensor, lambda k, s=state: field(told[f"{s}_light_{k}"])), FINE, 1
            )
            light = np.maximum(paint, 0.0) * np.maximum(lit, 0.0)
            found[name] = pixels(light[None], case["blur_px"])[0]
        np.savez(f"{state}.npz", **found)


main()
