"""The job kinds by name, for the shell to offer: to import all kinds takes seconds, and Tab should not."""

from __future__ import annotations

from collections.abc import Mapping

EVERYTHING = "pipeline"
KINDS: Mapping[str, str] = {
    "acquire": "record every view of a state with the instruments of the rig",
    "align": "how other campaigns' views lie to this one's, by the texture of the specimen, and the residual",
    "assess": "compare a tuple's results on the virtual rig with the exact truth",
    "calibrate": "calibrate a rig from poses of a ball bar and of a board",
    "calibrate-boards": "calibrate a rig from poses of a board",
    "combine": "one surface of this campaign's and other positions' views of a state, none of it doubled",
    "conditions": "write what the iDICs Good Practices Guide asks to be reported, as a table",
    "correlate": "displacement from two states: texture matched region by region, looked up in both surfaces",
    "cracks": "opening and sliding along cracks, from stored displacement",
    "deviate": (
        "the shape at a state against the campaign's reference surface: registration, deviation, verdict"
    ),
    "diagnose": "the projector's response, from the fringes themselves, and the ripple that it causes",
    "export": "write what is known of a state for Tecplot, ParaView, CAD, MATLAB and spreadsheets",
    "gauges": "strain that virtual gauges at given places read, from stored displacement",
    "merge": "views of a camera merged by inverse variance, and all cameras joined into one surface",
    "mesh": "the shape at a state as one mesh of all cameras, with texture, small holes filled on request",
    "observe-bar": "find the spheres of a ball bar and points on them",
    "observe-board": "find the points of a calibration board in camera and projector",
    "plane": "the image of a camera alone as a surface: where the specimen is, and how large a pixel",
    "quick-look": (
        "seconds after a recording: shape at some pixels, displacement at the gauges, what is wrong"
    ),
    "reconstruct": (
        "shape from fringes: phase gradients, points, their covariance, and a reason for every gap"
    ),
    "relative": "displacement without the rigid motion of a region, which is stated with its deviations",
    "report": (
        "write pages about a campaign: maps to zoom and turn, charts, uncertainties, errors and origins"
    ),
    "report-state": "write a page about one state: maps to zoom and turn, uncertainties and origins",
    "simulate": "render every view of a state on the virtual rig",
    "stereo": "shape from the images of several cameras: textures matched between them, rays met",
    "strain": "strain in the tangent plane, with principal and equivalent strain, over a stated gauge length",
    "stream": "record cameras without a projector at a rate; their frames become states",
    "system-test": "errors of form, size, distance, length or flatness of an artefact with a certificate",
}
"""Each with its summary, as the kind states them; a test compares, and says what is missing."""
