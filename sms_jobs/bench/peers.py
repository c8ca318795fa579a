"""Other programs beside ours: where they are, and how both are timed in turn on the same input.

They live in an environment of their own, which `ops/peers.sh` makes and `SMS_TEST_PEERS` names. Each is
started once, loads and compiles, and then measures once for every line that it is sent.
"""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import sms_jobs
from sms_jobs.bench.figures import Figure
from sms_jobs.errors import SmsError

PEERS = "SMS_TEST_PEERS"
NO_PEERS = f"{PEERS} names no folder that ops/peers.sh has made; set it to the folder that this prints"
"""Why figures beside other programs are left out."""
ROUNDS = 5
SCRIPTS = Path(sms_jobs.__file__).parents[1] / "ops" / "peers"

_SAID = "cpu_s "  # before the seconds of a round, among whatever else a program prints
ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"
)
"""What libraries are told: a second thread takes CPU time to wait."""

Timed = Callable[[], float]
"""Does the work once and returns the CPU-seconds that it took."""


@dataclass(frozen=True)
class Ratio:
    """By how much we are faster: CPU time of another program over ours, of each round."""

    rounds: tuple[float, ...]

    def figure(self, name: str, target: float | None = None) -> Figure:
        """Return the median of the rounds as a figure."""
        return Figure(name, median(self.rounds), "1", target)

    def told(self) -> str:
        """Return the spread in words."""
        return f"median of {len(self.rounds)} rounds, {min(self.rounds):.3g} to {max(self.rounds):.3g}"


def peers_folder() -> Path | None:
    """Return the folder of the other programs; None where none that has them is named, or without scripts."""
    named = os.environ.get(PEERS)
    return Path(named) if named and _python(Path(named)).exists() and SCRIPTS.is_dir() else None


def missing_peers(**programs: str) -> str:
    """Say what is missing beside us, in a sentence; empty if nothing is.

    Parameters
    ----------
    programs
        By name, what the Python of their environment runs if they are there.
    """
    folder = peers_folder()
    if folder is None:
        return NO_PEERS
    missing = []
    for name, line in programs.items():
        command: list[str | Path] = [_python(folder), "-P", "-c", line]
        done = subprocess.run(command, env=_environment(), capture_output=True, text=True, check=False)
        if done.returncode:
            missing.append(f"{name} does not run: {_reason(done.stderr)}")
    return "; ".join(missing)


def run_script(peers: Path, script: str, folder: Path) -> None:
    """Run one of the scripts by the environment of the others, in a folder; `SmsError` if it fails."""
    done = subprocess.run(
        _command(peers, script), cwd=folder, env=_environment(), capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise SmsError(f"{script} failed: {_reason(done.stderr or done.stdout)}")


@contextmanager
def started(peers: Path, folder: Path, script: str, *words: str) -> Iterator[Timed]:
    """Start one of the scripts in a folder, with words of its own, and wait until it has loaded and compiled.

    What is yielded lets it measure once; `SmsError` where it ends before it has.
    """
    log = folder / f"{'-'.join((script, *words))}.log"
    with (
        log.open("w", encoding="utf-8") as errors,
        subprocess.Popen(
            [*_command(peers, script), *words],
            cwd=folder,
            env=_environment(),
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
        ) as process,
    ):
        assert process.stdin is not None
        assert process.stdout is not None
        output = process.stdout

        def heard() -> float:
            for line in output:
                if line.startswith(_SAID):
                    return float(line.removeprefix(_SAID))
            raise SmsError(f"{script} failed: {_reason(log.read_text(encoding='utf-8'))}")

        def measured() -> float:
            assert process.stdin is not None
            process.stdin.write("again\n")
            process.stdin.flush()
            return heard()

        heard()  # the first time is said unasked, and compiles
        try:
            yield measured
        finally:
            process.stdin.close()


def timed(work: Callable[[], object]) -> Timed:
    """Return what does some work of this process once, all its threads counted, and tells its CPU-seconds.

    The work is done once before, which compiles.
    """
    work()

    def measured() -> float:
        before = time.process_time()
        work()
        return time.process_time() - before

    return measured


def in_turn(ours: Timed, theirs: Sequence[Timed], rounds: int = ROUNDS) -> list[Ratio]:
    """Measure our work and that of others in turn, round by round, and return the ratio to each of them."""
    found: list[list[float]] = [[] for _ in theirs]
    for _ in range(rounds):
        here = ours()
        for ratios, other in zip(found, theirs, strict=True):
            ratios.append(other() / here)
    return [Ratio(tuple(ratios)) for ratios in found]


def _command(peers: Path, script: str) -> list[str | Path]:
    return [_python(peers), SCRIPTS / script]


def _python(peers: Path) -> Path:
    return peers / "bin" / "python"


def _environment() -> dict[str, str]:
    return os.environ | ONE_THREAD


def _reason(said: str) -> str:
    return (said.strip().splitlines()[-1:] or ["no message"])[0]
