"""Flipped bits of a small archive file: each is noticed by verification, or changes nothing that is read.

One bit in 149 is flipped, which comes to every place within a byte. Every bit takes some minutes:

    bash ops/test.sh -m long tests/unit/archive/test_bit_flips.py -s

The file is checked in a process that is watched, as `Checker` does it: HDF5 may crash or never end.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from support.sealing import damaged, provenance, regions

from sms_jobs.archive import Archive, Checker, Sealed
from sms_jobs.errors import ArchiveCorrupt, OtherFormat

# The work of one process: flip, check, read where the check passes, flip back; a line for every flip.
# The limit counts the processor's time, so that a busy machine does not look like a file that never ends:
# an undamaged file takes about a millisecond.
FLIP = """
import os, resource, signal, sys
from pathlib import Path
from sms_jobs.archive.dataset import check_dataset, open_dataset
from sms_jobs.errors import ArchiveCorrupt, OtherFormat
from sms_jobs.records.fields import Regions

file, content_hash, start, stop, step = Path(sys.argv[1]), sys.argv[2], *map(int, sys.argv[3:])
resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
data = file.read_bytes()

def read():
    with open_dataset(file, "it") as dataset:
        record = dataset.read("regions", Regions)
        return (dataset.provenance, dataset.names, dataset.content_hash, dataset.describe(),
                record.regions, record.labels.shape, record.labels.dtype, record.labels.tobytes())

good = read()
descriptor = os.open(file, os.O_RDWR)
for bit in range(start, stop, step):
    byte, place = divmod(bit, 8)
    os.pwrite(descriptor, bytes([data[byte] ^ (1 << place)]), byte)
    signal.setitimer(signal.ITIMER_PROF, 0.5)
    try:
        check_dataset(file, "it", content_hash)
    except (ArchiveCorrupt, OtherFormat):
        told = "noticed"
    else:
        told = "same" if read() == good else "changed"
    signal.setitimer(signal.ITIMER_PROF, 0)
    os.pwrite(descriptor, data[byte:byte + 1], byte)
    print(bit, told, flush=True)
"""


@pytest.fixture
def small(archive: Archive) -> Sealed:
    return archive.seal_dataset({"regions": regions()}, provenance())


def flipped(file: Path, content_hash: str, bits: range) -> dict[int, str]:
    """Return what was told of each flipped bit; "ended" where it ended the process that read it."""
    data = file.read_bytes()
    told: dict[int, str] = {}
    start = bits.start
    while start < bits.stop:
        arguments = [str(file), content_hash, str(start), str(bits.stop), str(bits.step)]
        done = subprocess.run(
            [sys.executable, "-c", FLIP, *arguments],
            capture_output=True,
            text=True,
            timeout=3600,
            check=False,
        )
        lines = [line.split() for line in done.stdout.splitlines()]
        told |= {int(bit): what for bit, what in lines}
        start = int(lines[-1][0]) + bits.step if lines else start
        if start < bits.stop:
            # By a signal: an exception that the check does not expect would end the program that verifies.
            assert done.returncode < 0, f"bit {start}: {done.stderr[-2000:]}"
            told[start] = "ended"
            file.write_bytes(data)
            start += bits.step
    return told


def judged(told: dict[int, str], bits: range) -> None:
    """Require that every bit was flipped and none changed what is read."""
    assert sorted(told) == list(bits)
    counted = Counter(told.values())
    print(f"{len(told)} bits:", dict(counted))
    assert [bit for bit, what in told.items() if what == "changed"] == []
    # Much of a small file is room that HDF5 reserves, and texts for viewers that this program does not read.
    assert counted["noticed"] + counted["ended"] > len(told) // 4


def test_a_flipped_bit_is_noticed_or_changes_nothing(archive: Archive, small: Sealed) -> None:
    file = archive.store.path(small.path)
    file.chmod(0o644)
    bits = range(0, 8 * small.size_bytes, 149)
    judged(flipped(file, small.content_hash, bits), bits)


@pytest.mark.long
def test_every_flipped_bit_is_noticed_or_changes_nothing(archive: Archive, small: Sealed) -> None:
    count = 8 * small.size_bytes
    processes = max(1, (os.cpu_count() or 1) // 2)
    part = -(-count // processes)
    parts = [range(start, min(start + part, count)) for start in range(0, count, part)]
    copies = [archive.store.root / f"copy-{number}.h5" for number in range(len(parts))]
    for copy in copies:
        shutil.copyfile(archive.store.path(small.path), copy)
    with ThreadPoolExecutor(processes) as pool:
        told = list(pool.map(flipped, copies, [small.content_hash] * len(parts), parts))
    judged({bit: what for some in told for bit, what in some.items()}, range(count))


def test_verification_outlives_what_ends_its_reader(archive: Archive, small: Sealed) -> None:
    pristine = archive.store.path(small.path).read_bytes()
    with Checker() as checker:
        for byte in range(0, len(pristine), len(pristine) // 20):
            damaged(archive, small, lambda data, at=byte: data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :])
            try:
                archive.verify(small.path, small.content_hash, checker)
            except (ArchiveCorrupt, OtherFormat):
                continue
        damaged(archive, small, lambda _: pristine)
        archive.verify(small.path, small.content_hash, checker)
