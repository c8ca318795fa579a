"""What a job that succeeds remarks about its data, in the words with which it ends."""

from __future__ import annotations

_NOTE = "note: "
PARTED = f"; {_NOTE}"
"""Parts what a job has done from what it remarks."""


def remarked(*remarks: str, beside: str = "") -> str:
    """Return the words with which a job ends, with what whoever waits for it has to know of its data.

    Empty remarks count as none; `beside` is what it has done.
    """
    note = "; ".join(filter(None, remarks))
    return "; ".join(filter(None, (beside, note and _NOTE + note)))


def remarks_in(message: str) -> str:
    """Return what the message of a job that has succeeded remarks about its data; empty without."""
    return message.partition(PARTED)[2]
