"""Messages of bags that are compressed one by one."""

from __future__ import annotations

from typing import Any

import zstandard


def unpacked_message(data: Any) -> bytes:
    """The bytes of a message that is one zstd frame, whose size need not stand in it. Raises `zstandard.ZstdError`."""
    reader = zstandard.ZstdDecompressor().decompressobj()
    found = reader.decompress(data)
    if not reader.eof:
        raise zstandard.ZstdError("the frame is cut off")
    return found
