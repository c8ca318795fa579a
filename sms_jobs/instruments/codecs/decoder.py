"""What all decoders of byte streams have in common."""

from __future__ import annotations

from typing import Protocol, TypeVar

Frame = TypeVar("Frame")


class Decoder(Protocol[Frame]):
    """Finds frames in bytes that come in any pieces, with any noise between them; never raises on noise."""

    def feed(self, data: bytes) -> list[Frame]:
        """Take bytes and return the frames that they complete."""
        ...

    def reset(self) -> None:
        """Forget the beginning of a frame."""
        ...
