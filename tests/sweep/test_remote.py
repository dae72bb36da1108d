"""Recordings of a sweep by URL: found in folders of a web server or a store, told apart by what that says of them."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import pytest

from dataflow.sweep.plan import Digests, Source, SweepError, file_name, sources_in

fsspec = pytest.importorskip("fsspec", reason="fsspec (the [remote] extra) is not installed")


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, format: str, *args: object) -> None:
        """Prints nothing."""


@pytest.fixture
def web(tmp_path: Path) -> Iterator[str]:
    """The address of a web server of a folder with two recordings."""
    pytest.importorskip("aiohttp", reason="aiohttp (the [remote] extra) is not installed")
    (tmp_path / "runs" / "second").mkdir(parents=True)
    (tmp_path / "empty").mkdir()
    for name in ("a.mcap", "notes.txt", "second/b.mcap"):
        (tmp_path / "runs" / name).write_text(f"content of {name}")
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(tmp_path))) as server:
        serving = threading.Thread(target=server.serve_forever, args=(0.01,), daemon=True)
        serving.start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()
        serving.join(10)


def found(tmp_path: Path, *urls: str) -> list[Source]:
    return sources_in(urls, Digests(tmp_path / "none.json"))


@pytest.mark.parametrize("folder", ["runs", "runs/"])
def test_the_folder_of_a_web_server_is_searched_at_any_depth(web: str, tmp_path: Path, folder: str) -> None:
    sources = found(tmp_path, f"{web}/{folder}", f"{web}/runs/a.mcap")

    assert [source.name for source in sources] == ["a.mcap", "second/b.mcap"]
    assert [source.where for source in sources] == [f"{web}/runs/a.mcap", f"{web}/runs/second/b.mcap"]


def test_a_recording_that_was_replaced_on_a_web_server_is_another_one(web: str, tmp_path: Path) -> None:
    first, same = (found(tmp_path, f"{web}/runs/a.mcap") for _ in range(2))
    file = tmp_path / "runs" / "a.mcap"
    file.write_text("another content")
    os.utime(file, (1e9, 1e9))

    assert first == same != found(tmp_path, f"{web}/runs/a.mcap")


def test_missing_paths_of_a_web_server_are_reported(web: str, tmp_path: Path) -> None:
    for path in ("nowhere", "nowhere/a.mcap"):
        with pytest.raises(SweepError, match=f"no file or folder {web}/{path}"):
            found(tmp_path, f"{web}/{path}")
    with pytest.raises(SweepError, match="/empty holds no recording"):
        found(tmp_path, f"{web}/empty")


def test_recording_in_a_store_without_times_or_tags_is_never_reused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = fsspec.filesystem("memory")
    store.pipe("/untold/a.mcap", b"content")
    assert found(tmp_path, "memory://untold") == found(tmp_path, "memory://untold")
    info = type(store).info
    monkeypatch.setattr(
        type(store), "info", lambda *args, **more: {k: v for k, v in info(*args, **more).items() if k != "created"}
    )
    assert found(tmp_path, "memory://untold") != found(tmp_path, "memory://untold")


@pytest.mark.parametrize(("url", "package"), [("s3://bucket/runs", "s3fs"), ("http://127.0.0.1:9/runs", "aiohttp")])
def test_the_package_that_a_url_lacks_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, url: str, package: str
) -> None:
    for name in [name for name in sys.modules if name.partition(".")[0] in ("s3fs", "aiohttp")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.delitem(sys.modules, "fsspec.implementations.http", raising=False)
    monkeypatch.setitem(sys.modules, package, None)
    monkeypatch.delitem(vars(sys.modules["fsspec.registry"])["_registry"], "http", raising=False)
    with pytest.raises(SweepError, match=f"{url} cannot be read: .*{package}"):
        found(tmp_path, url)


def test_unreachable_web_server_is_distinguished_from_missing_file(tmp_path: Path) -> None:
    pytest.importorskip("aiohttp", reason="aiohttp (the [remote] extra) is not installed")
    with pytest.raises(SweepError, match=r"no file or folder http://127\.0\.0\.1:1/runs: .*[Cc]onnect"):
        found(tmp_path, "http://127.0.0.1:1/runs")


def test_a_store_that_is_not_reached_or_not_known_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(SweepError, match=r"nope://bucket/a\.mcap cannot be read: Protocol not known: nope"):
        found(tmp_path, "nope://bucket/a.mcap")


@pytest.mark.parametrize(
    ("url", "name"),
    [
        ("https://host/runs/a.mcap?signature=b/c", "a.mcap"),
        ("http://host/a.mcap", "a.mcap"),
        ("bucket/what?.mcap", "what?.mcap"),
    ],
)
def test_the_query_of_an_address_is_no_part_of_the_file_name(url: str, name: str) -> None:
    assert file_name(url) == name
