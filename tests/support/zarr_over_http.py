"""Zarr groups that the service gives; loads Zarr, which takes a second."""

from __future__ import annotations

from typing import Any

import httpx2
import zarr
from zarr.abc.store import OffsetByteRequest, RangeByteRequest, Store
from zarr.core.buffer import Buffer, BufferPrototype


class OverHttp(Store):
    """The Zarr group of a file, as any reader of Zarr sees it."""

    supports_writes = supports_deletes = supports_listing = False

    def __init__(self, web: httpx2.Client, file: int, form: str = "zarr") -> None:
        super().__init__(read_only=True)
        self._web, self._group = web, f"/data/{file}/{form}"
        self.received = 0

    def __eq__(self, other: object) -> bool:
        return self is other

    async def get(self, key: str, prototype: BufferPrototype, byte_range: Any = None) -> Buffer | None:
        found = self._web.get(f"{self._group}/{key}")
        if found.status_code == 404:
            return None
        content = found.raise_for_status().content
        self.received += len(content)
        if isinstance(byte_range, RangeByteRequest):
            content = content[byte_range.start : byte_range.end]
        elif isinstance(byte_range, OffsetByteRequest):
            content = content[byte_range.offset :]
        return prototype.buffer.from_bytes(content)

    async def get_partial_values(self, prototype: BufferPrototype, key_ranges: Any) -> list[Buffer | None]:
        return [await self.get(key, prototype, wanted) for key, wanted in key_ranges]

    async def exists(self, key: str) -> bool:
        return self._web.get(f"{self._group}/{key}").is_success

    async def set(self, key: str, value: Buffer) -> None:
        raise AssertionError(key)

    async def delete(self, key: str) -> None:
        raise AssertionError(key)

    async def list(self) -> Any:
        return
        yield

    async def list_prefix(self, prefix: str) -> Any:
        return
        yield

    async def list_dir(self, prefix: str) -> Any:
        return
        yield


def opened_group(web: httpx2.Client, file: int, form: str = "zarr") -> tuple[zarr.Group, OverHttp]:
    """Open the group of a file, and return it with its store, which counts what it receives."""
    store = OverHttp(web, file, form)
    return zarr.open_group(store, mode="r"), store
