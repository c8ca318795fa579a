"""Run by the peers' environment in a folder that `sms bench peers` has prepared: decode frames with fringes.

    python decode_fringes.py

Reads `case.json` and `frames.npy`, (directions * densities * steps, rows, columns); writes `fringes.npz` with
the phase gradient of both directions, and answers round by round with the CPU time of a decoding, whose
verbose one has the residual as well.
"""

import json
import sys
from pathlib import Path

import numpy as np
from fringes import Fringes
from rounds import answer


def main() -> None:
    """Decode frames again and again."""
    case = json.loads(Path("case.json").read_text())
    frames = np.load("frames.npy")
    coding = Fringes()
    coding.reset()
    # Both directions are coded over one length: it searches no fringe orders beyond a shorter one.
    coding.Y = coding.X = max(frames.shape[1:])
    coding.D, coding.N, coding.p0 = case["directions"], case["steps"], 0.0
    coding.v = [case["densities"]] * case["directions"]
    # Its phase steps run the other way.
    steps = frames.reshape(-1, case["steps"], *frames.shape[1:])
    frames = np.ascontiguousarray(np.roll(steps[:, ::-1], 1, axis=1)).reshape(frames.shape)
    verbose = sys.argv[1:] == ["verbose"]
    position = coding.decode(frames, threads=1).x
    turn = 2.0 * np.pi * position[..., 0] / coding.Lext
    np.savez("fringes.npz", omega=turn)
    answer(lambda: coding.decode(frames, threads=1, verbose=verbose))


main()
