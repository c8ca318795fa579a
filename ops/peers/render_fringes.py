"""Run by the peers' environment in a folder that `sms bench witness` has prepared: render with Mitsuba.

    python render_fringes.py

Reads `case.json` (sensors with OpenCV's parameters, fringes, the lens) and `sheets.npz`
(meshes of the specimen at each state, with their paint); writes `STATE.npz` with the light of each pixel
under a white projector, `white`, and under each pattern's cosine and sine, `cosine` and `sine`, and what even
light would show, `even`, and at the first state `hits.npz` with what the rays through the pixels' centres
meet: number of the sheet, -1 for none, and place in it.

Cameras and projectors are told by OpenCV's model alone: rays are undistorted by OpenCV, and the bitmap that
Mitsuba's pin-hole projector throws is drawn as the distorted projector would throw it.
"""

import json
from pathlib import Path

import cv2
import drjit as dr
import mitsuba as mi
import numpy as np
from pixels import FINE, pixels
from scipy.ndimage import binary_dilation

mi.set_variant("llvm_ad_rgb")

TEXELS = 2  # along a projector's pixel


def sensor(told):
    """Return camera matrix, distortion, rotation and pin-hole of a sensor that the case tells."""
    rotation = np.array(told["rotation"])
    centre = -rotation.T @ np.array(told["translation"])
    return np.array(told["matrix"]), np.array(told["distortion"]), rotation, centre


def undistorted(matrix, distortion, pixels):
    """Return where pixels (n, 2) lie in the image of a pin-hole at unit distance."""
    accurate = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-12)
    points = np.ascontiguousarray(pixels, np.float64).reshape(-1, 1, 2)
    return cv2.undistortPoints(points, matrix, distortion, criteria=accurate).reshape(-1, 2)


class Camera:
    """Rays of a camera, at evenly spread places of its pixels."""

    def __init__(self, told, lens):
        """Take a camera and, where it is no pin-hole, its lens: aperture and distance in focus, in mm."""
        self.columns, self.rows = told["columns"], told["rows"]
        self.matrix, self.distortion, self.rotation, self.centre = sensor(told)
        self.lens = lens
        # Corners of the fine pixels: what lies between is found by straight lines, good to 1e-5 px.
        x = np.arange(FINE * self.columns + 1) / FINE - 0.5
        y = np.arange(FINE * self.rows + 1) / FINE - 0.5
        corners = np.stack(np.meshgrid(x, y), axis=-1)
        self.corners = undistorted(self.matrix, self.distortion, corners.reshape(-1, 2)).reshape(
            corners.shape
        )

    def centres(self):
        """Return the rays through the pixels' centres, and the middle of the lens."""
        x, y = np.meshgrid(np.arange(self.columns, dtype=float), np.arange(self.rows, dtype=float))
        return self.towards(undistorted(self.matrix, self.distortion, np.stack([x.ravel(), y.ravel()], 1)))

    def through(self, s, t, chosen, lens):
        """Return the rays through the place (s, t), 0 .. 1, of the fine pixels that are chosen.

        `lens` is where they go through the lens, in units of its radius.
        """
        c = self.corners
        upper = (1.0 - s) * c[:-1, :-1] + s * c[:-1, 1:]
        lower = (1.0 - s) * c[1:, :-1] + s * c[1:, 1:]
        return self.towards(((1.0 - t) * upper + t * lower)[chosen], lens)

    def towards(self, image, lens=(0.0, 0.0)):
        """Return rays towards points of the image at unit distance, through a place of the lens."""
        direction = np.column_stack([image, np.ones(len(image))])
        start = np.zeros(3)
        if self.lens is not None:
            start[:2] = 0.5 * self.lens["aperture_mm"] * np.array(lens)
            direction = self.lens["focus_mm"] * direction - start
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        origin = mi.Point3f((self.centre + start @ self.rotation)[:, None])
        dr.make_opaque(origin)
        ray = mi.Ray3f(origin, mi.Vector3f((direction @ self.rotation).T))
        return mi.RayDifferential3f(ray)


class Projector:
    """What a projector throws, as the bitmap of a pin-hole that has no distortion."""

    def __init__(self, told, distance):
        """Take a projector, and the distance at which it lights a facing white surface with 1."""
        self.columns, self.rows = told["columns"], told["rows"]
        matrix, distortion, rotation, centre = sensor(told)
        x, y = np.arange(self.columns + 1) - 0.5, np.arange(self.rows + 1) - 0.5
        border = [(a, b) for a in x for b in y[[0, -1]]] + [(a, b) for a in x[[0, -1]] for b in y]
        half = 1.01 * np.abs(undistorted(matrix, distortion, np.array(border))).max(axis=0)
        texel = 1.0 / (TEXELS * matrix[0, 0])
        self.size = 2 * np.ceil(half / texel).astype(int)
        u, v = (texel * (np.arange(n) + 0.5 - n / 2) for n in self.size)
        pinhole = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
        space = np.column_stack([pinhole, np.ones(len(pinhole))])
        self.pixels = cv2.projectPoints(space, np.zeros(3), np.zeros(3), matrix, distortion)[0].reshape(-1, 2)
        lit = (self.pixels > -0.5).all(1) & (self.pixels < [self.columns - 0.5, self.rows - 0.5]).all(1)
        # Mitsuba lights a plane evenly; a lamp behind a pin-hole sends as much into every direction.
        self.strength = lit * distance**2 * (1.0 + (pinhole**2).sum(1)) ** -1.5
        self.fov = float(np.degrees(2.0 * np.arctan(0.5 * texel * self.size[0])))
        self.to_world = np.eye(4)
        self.to_world[:3, :3] = np.stack([-rotation[0], -rotation[1], rotation[2]], axis=1)
        self.to_world[:3, 3] = centre

    def phase(self, orientation, density):
        """Return the phase of fringes at every texel: docs/conventions.md."""
        a, b = np.cos(orientation), np.sin(orientation)
        across = a * (self.pixels[:, 0] + 0.5 - self.columns / 2)
        down = b * (self.pixels[:, 1] + 0.5 - self.rows / 2)
        return 2.0 * np.pi * density * (across + down) / (self.columns * abs(a) + self.rows * abs(b))

    def bitmap(self, phase):
        """Return white, cosine and sine as three colours, none of them negative."""
        colours = np.stack([np.ones_like(phase), 0.5 + 0.5 * np.cos(phase), 0.5 + 0.5 * np.sin(phase)], 1)
        image = (colours * self.strength[:, None]).astype(np.float32)
        return mi.TensorXf(image.reshape(self.size[1], self.size[0], 3))

    def emitter(self):
        """Return it as Mitsuba has it."""
        image = {
            "type": "bitmap",
            "data": self.bitmap(np.zeros(len(self.pixels))),
            "raw": True,
            "filter_type": "bilinear",
            "wrap_mode": "clamp",
        }
        return {
            "type": "projector",
            "to_world": mi.ScalarTransform4f(self.to_world),
            "fov": self.fov,
            "fov_axis": "x",
            "irradiance": image,
        }


def material(paint):
    """Return diffuse paint, on both sides."""
    image = mi.TensorXf(paint.astype(np.float32)[:, :, None])
    colour = {"type": "bitmap", "data": image, "raw": True, "filter_type": "bilinear", "wrap_mode": "clamp"}
    return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": colour}}


def sheet(name, place, kept, bsdf):
    """Return a mesh of two triangles a cell: places (m, n, 3) in the world, and which cells there are."""
    m, n = place.shape[:2]
    number = np.arange(m * n).reshape(m, n)
    corner = [number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]]
    a, b, c, d = (each[kept] for each in corner)
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    uv = np.stack(np.meshgrid(np.linspace(0, 1, m), np.linspace(0, 1, n), indexing="ij"), axis=-1)
    properties = mi.Properties()
    properties["mesh_bsdf"] = mi.load_dict(bsdf)
    properties["face_normals"] = True
    mesh = mi.Mesh(name, m * n, len(faces), has_vertex_texcoords=True, props=properties)
    told = mi.traverse(mesh)
    told["vertex_positions"] = mi.Float(place.astype(np.float32).ravel())
    told["vertex_texcoords"] = mi.Float(uv.astype(np.float32).ravel())
    told["faces"] = mi.UInt32(faces.astype(np.uint32).ravel())
    told.update()
    return mesh


def hits(scene, camera, sheets):
    """Return which sheet the rays through the pixels' centres meet, -1 for none, and where in it (u, v)."""
    met = scene.ray_intersect(camera.centres())
    number = np.full((camera.rows, camera.columns), -1)
    for index, shape in enumerate(sheets):
        number[np.array(met.is_valid() & (met.shape == mi.ShapePtr(shape))).reshape(number.shape)] = index
    return number, np.array(met.uv).reshape(2, *number.shape)


def spread(camera, chosen, side):
    """Return side * side bundles of rays through the fine pixels that are chosen, one ray through each.

    The rays of every pixel go through the same places of the lens, a sunflower's: what is out of focus is
    blurred alike everywhere, without noise.
    """
    places = (np.arange(side) + 0.5) / side
    count = side * side
    found = []
    for number, (s, t) in enumerate((s, t) for s in places for t in places):
        seed = 7 * number % count  # neighbours within the pixel are none on the lens
        turn, radius = seed * np.pi * (3.0 - np.sqrt(5.0)), np.sqrt((seed + 0.5) / count)
        found.append(camera.through(s, t, chosen, (radius * np.cos(turn), radius * np.sin(turn))))
    return found


def imaged(bundles, chosen, blur, value):
    """Return images (n, rows, columns) of what `value(rays, number)` tells of bundles of rays, their mean."""
    total = 0.0
    for number, rays in enumerate(bundles):
        total = total + value(rays, number)
        dr.eval(total)
    found = np.array(total).reshape(-1, np.count_nonzero(chosen)) / len(bundles)
    fine = np.zeros((len(found), *chosen.shape))
    fine[:, chosen] = found
    return pixels(fine, blur)


def light(scene, integrator):
    """Return what tells the light, in three colours, that comes along rays."""

    def value(rays, number):
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(number, dr.width(rays.d))
        return integrator.sample(scene, sampler, rays)[0]

    return value


def even(scene):
    """Return what tells the paint's reflectance that rays meet: what even light would show."""

    def value(rays, number):
        met = scene.ray_intersect(rays)
        return dr.select(met.is_valid(), met.bsdf(rays).eval_diffuse_reflectance(met).x, 0.0)

    return value


def main():
    """Render all states."""
    case = json.loads(Path("case.json").read_text())
    told = np.load("sheets.npz")
    camera = Camera(case["camera"], case["lens"])
    projector = Projector(case["projector"], case["distance_mm"])
    integrator = mi.load_dict({"type": "direct", "emitter_samples": 1, "bsdf_samples": 0})
    patterns = [(a, t) for a in case["orientations_rad"] for t in case["densities"]]
    for state in case["states"]:
        shapes = [
            sheet(
                f"sheet{k}",
                told[f"{state}_{k}"],
                told[f"kept_{k}"],
                material(told[f"paint_{k}"]),
            )
            for k in range(case["sheets"])
        ]
        scene = mi.load_dict(
            {"type": "scene", "projector": projector.emitter()}
            | {f"sheet{k}": s for k, s in enumerate(shapes)}
        )
        number, place = hits(scene, camera, shapes)
        if state == case["states"][0]:
            np.savez("hits.npz", number=number, place=place)
        # A lens that is out of focus sees beyond the edge.
        near = binary_dilation(number >= 0, iterations=3 if case["lens"] is None else 12)
        chosen = near.repeat(FINE, axis=0).repeat(FINE, axis=1)
        how = spread(camera, chosen, case["rays"]), chosen, case["blur_px"]
        shown = mi.traverse(scene)
        (bitmap,) = [key for key, _ in shown if key.endswith("irradiance.data")]
        found = []
        for orientation, density in patterns:
            shown[bitmap] = projector.bitmap(projector.phase(orientation, density))
            shown.update()
            found.append(imaged(*how, light(scene, integrator)))
        white, cosine, sine = np.stack(found, axis=1)
        np.savez(
            f"{state}.npz",
            white=white[0],
            cosine=2.0 * cosine - white,
            sine=2.0 * sine - white,
            even=imaged(*how, even(scene))[0],
        )


main()
