"""Run by the peers' environment in a folder: render a plate, and one with a hole, and write its mesh.

    python render_plates.py

The images lie where pyvale's examples put them; `mesh.npz` holds nodes and their displacement in m.
"""

import numpy as np
import riley
from pyvale import data, render


def main() -> None:
    """Render what is not there yet, and write the mesh of the plate with a hole."""
    render.create_example_images_rigid()
    render.create_example_images_platehole()
    mesh = riley.load_exodus(data.dic_platehole_exodus_path(), connect_keys=("connect1",), nodal_keys="all")
    moved = [np.asarray(mesh.nodal_vars[f"disp_{axis}"])[..., -1] for axis in "xy"]
    elements = np.asarray(mesh.elem_blocks["connect1"].connect) - 1
    np.savez(
        "mesh.npz", nodes=np.asarray(mesh.coords)[:, :2], elements=elements, displacement=np.stack(moved, 1)
    )


main()
