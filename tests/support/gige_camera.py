"""A GigE Vision camera on the loopback interface: the one that Aravis brings, in a process of its own."""

from __future__ import annotations

import ctypes
import fcntl
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from support.missing import do_without

ADDRESS = "127.0.0.1"
SERIAL = "SMS-1"
_CAMERA = f"""
import ctypes, sys
aravis = ctypes.CDLL("libaravis-0.8.so.0")
aravis.arv_gv_fake_camera_new.restype = ctypes.c_void_p
aravis.arv_gv_fake_camera_new.argtypes = [ctypes.c_char_p, ctypes.c_char_p]
aravis.arv_gv_fake_camera_is_running.argtypes = [ctypes.c_void_p]
camera = aravis.arv_gv_fake_camera_new(b"{ADDRESS}", b"{SERIAL}")
aravis.g_object_set(ctypes.c_void_p(camera), b"gvsp-lost-ratio", ctypes.c_double(float(sys.argv[1])), None)
print(aravis.arv_gv_fake_camera_is_running(camera), flush=True)
sys.stdin.read()
"""


@contextmanager
def gige_camera(lost_packets: float = 0.0) -> Iterator[subprocess.Popen[str]]:
    """Start the camera, which loses that part of its packets; without Aravis, skip, or fail where CI=true.

    Its port belongs to the standard, so that one camera can be on the interface at a time: others wait.
    """
    try:
        ctypes.CDLL("libaravis-0.8.so.0")
    except OSError:
        reason = "needs the library Aravis 0.8: run ops/test.sh, or install the package aravis-tools-cli"
        do_without(reason, insist=sys.platform == "linux")
    with (Path(tempfile.gettempdir()) / "sms-test-gige-camera.lock").open("w") as turn:
        fcntl.flock(turn, fcntl.LOCK_EX)
        words = [sys.executable, "-c", _CAMERA, str(lost_packets)]
        with subprocess.Popen(
            words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        ) as process:
            assert process.stdout is not None
            try:
                assert process.stdout.readline().strip() == "1", "the camera did not start"
                yield process
            finally:
                process.kill()
