"""Keys by which machines and tools know each other: an authority of the user's own and one certificate for each.

`openssl` makes them (P-256, ten years), so no library is needed. A certificate's common name is the machine's
name; that of every tool is `TOOLS`. Only the certificate of the supervisor's machine may serve: no robot can pass for
it.
"""

from __future__ import annotations

import contextlib
import errno
import ipaddress
import os
import re
import socket
import subprocess
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from dataflow.transport import NetworkError
from dataflow.transport.keys import local_key, runtime_key

TOOLS = "dataflow tools"
KEYS = "dataflow-machines"
"""The first chunk of the keys of agents and their runs."""
GRAPH_KEY = f"{KEYS}/graph"
"""Answers tools on other machines which graph runs."""
OVER_KEY = f"{GRAPH_KEY}/over"
"""Announces to them that a run is over, by its start."""
CONNECT_WITHIN = 3000
"""Milliseconds that a tool tries to reach another machine."""
DAYS = 3650
_AUTHORITY, _CERTIFICATE, _KEY = "authority.pem", "certificate.pem", "key.pem"
_AUTHORITY_KEY = "authority.key"
_MACHINE, _NAME = "machine", "name"
"""The file with the name of the machine, and that of one that serves."""
_HOST = re.compile(r"(?!-)[A-Za-z0-9-]{1,63}(\.[A-Za-z0-9-]{1,63})*\.?")
_ENDPOINT = re.compile(r"tls/[^/]+:\d{1,5}([?#].*)?")
_CURVE = ("-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-256", "-nodes")


class KeysError(RuntimeError):
    """Keys cannot be made or are incomplete; the message names the folder, and what would be right."""


def new_authority(folder: Path) -> None:
    """Makes a folder with a new authority, which issues keys. Raises `KeysError` where there is one."""
    if (folder / _AUTHORITY_KEY).exists():
        raise KeysError(f"{folder} has an authority already: keys that it issued would be worthless with another")
    with _made_for(folder) as scratch:
        made = ("-keyout", str(scratch / _AUTHORITY_KEY), "-out", str(scratch / _AUTHORITY))
        _openssl("req", "-x509", *_CURVE, "-days", str(DAYS), "-subj", "/CN=dataflow authority", *made)


def issue(authority: Path, folder: Path, name: str, *, serves: Iterable[str] = ()) -> None:
    """Makes the keys of a machine, or of `TOOLS`, in a folder to be taken there.

    `serves`: the addresses and host names by which others reach a supervisor there; without any it cannot be one.
    Raises `KeysError`.
    """
    if not (authority / _AUTHORITY_KEY).is_file():
        raise KeysError(f"{authority} has no {_AUTHORITY_KEY}; make an authority with: dataflow keys new {authority}")
    if (folder / _KEY).exists():
        raise KeysError(f"{folder} has keys already; name another folder")
    served = list(serves)
    if wrong := [each for each in served if not (_is_ip(each) or _HOST.fullmatch(each))]:
        raise KeysError(f"--serves {wrong[0]!r}: expected an address or host name, without a port")
    usage = "serverAuth,clientAuth" if served else "clientAuth"
    extensions = [f"extendedKeyUsage={usage}", "basicConstraints=CA:FALSE"]
    if served:
        extensions.append("subjectAltName=" + ",".join(f"{'IP' if _is_ip(s) else 'DNS'}:{s}" for s in served))
    with _made_for(folder) as made, tempfile.TemporaryDirectory() as scratch:
        request, wanted = Path(scratch, "request"), Path(scratch, "extensions")
        wanted.write_text("\n".join(extensions) + "\n")
        subject = f"/CN={name}"
        _openssl("req", "-new", *_CURVE, "-subj", subject, "-keyout", str(made / _KEY), "-out", str(request))
        by = ("-CA", str(authority / _AUTHORITY), "-CAkey", str(authority / _AUTHORITY_KEY), "-CAcreateserial")
        out = ("-extfile", str(wanted), "-out", str(made / _CERTIFICATE), "-days", str(DAYS))
        _openssl("x509", "-req", "-in", str(request), *by, *out)
        (made / _AUTHORITY).write_bytes((authority / _AUTHORITY).read_bytes())
        (made / _MACHINE).write_text(name)
        if served:
            (made / _NAME).write_text(name)


@contextlib.contextmanager
def _made_for(folder: Path) -> Iterator[Path]:
    """Gives a folder to make keys in, whose files are moved to `folder` when all of them are made."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder.parent) as scratch:
        yield Path(scratch)
        folder.mkdir(mode=0o700, exist_ok=True)
        for path in Path(scratch).iterdir():
            path.replace(folder / path.name)


def _is_ip(address: str) -> bool:
    try:
        ipaddress.ip_address(address)
    except ValueError:
        return False
    return True


def _openssl(*words: str) -> None:
    """Runs openssl, whose files only their owner can read. Raises `KeysError`."""
    before = os.umask(0o077)
    try:
        subprocess.run(["openssl", *words], check=True, capture_output=True, timeout=60, text=True)
    except FileNotFoundError:
        raise KeysError("openssl is not installed; it makes keys (Debian: apt install openssl)") from None
    except subprocess.SubprocessError as error:
        raise KeysError(f"openssl {words[0]}: {getattr(error, 'stderr', '') or error}") from error
    finally:
        os.umask(before)


def tool_settings(keys: Path | None, endpoint: str) -> dict[str, Any]:
    """Returns the settings of a tool at such an endpoint: routers carry nothing from one peer to another, so it is a
    client, which is opened when it is connected (bounded). Raises `NetworkError` as `settings`."""
    return {"mode": "client", "connect/timeout_ms": CONNECT_WITHIN, **settings(keys, endpoint)}


def settings(keys: Path | None, endpoint: str) -> dict[str, Any]:
    """Returns the settings of Zenoh for an endpoint between machines. Raises `NetworkError` where it would be open.

    Without keys only a Unix socket is allowed: any user of a machine can reach its loopback.
    """
    if keys is None:
        if endpoint.startswith("unixsock-stream/"):
            return {}
        raise NetworkError(f"{endpoint!r} needs keys: make them with `dataflow keys new FOLDER`, give them by --keys")
    if not _ENDPOINT.fullmatch(endpoint):
        raise NetworkError(f"endpoint {endpoint!r} with keys: expected tls/<address>:<port>")
    if missing := [name for name in (_AUTHORITY, _CERTIFICATE, _KEY) if not (keys / name).is_file()]:
        raise NetworkError(f"keys {str(keys)!r}: no {', '.join(missing)}; `dataflow keys add` makes such a folder")
    certificate, key = str(keys / _CERTIFICATE), str(keys / _KEY)
    tls = {
        "root_ca_certificate": str(keys / _AUTHORITY),
        "enable_mtls": True,
        "verify_name_on_connect": True,
        "connect_certificate": certificate,
        "connect_private_key": key,
        "listen_certificate": certificate,
        "listen_private_key": key,
    }
    return {"transport/link/tls": tls}


def own_name(keys: Path) -> str | None:
    """Returns the name in the certificate of a machine that serves; None for keys of before this was noted."""
    return (keys / _NAME).read_text() if (keys / _NAME).is_file() else None


def holder(keys: Path) -> str | None:
    """Returns the machine that keys were made for, or `TOOLS`; None of keys of before this was noted."""
    path = keys / _MACHINE
    return path.read_text() if path.is_file() else None


def require_machine(keys: Path, name: str) -> None:
    """Raises `KeysError` where keys are those of another machine than `name`, or of tools."""
    found = holder(keys)
    if found is not None and found != name:
        whose = "tools, which join no run" if found == TOOLS else f"machine {found!r}"
        raise KeysError(
            f"{keys} holds the keys of {whose}, not those of {name!r}: `dataflow keys add {name}` makes them"
        )


def require_serving(keys: Path) -> None:
    """Raises `KeysError` for keys of a machine that others cannot reach."""
    if (keys / _MACHINE).is_file() and not (keys / _NAME).is_file():
        raise KeysError(
            f"{keys} holds keys that cannot serve: those of the machine that runs the graph are made with "
            "`dataflow keys add NAME --serves ADDRESS`"
        )


def require_address(endpoint: str) -> None:
    """Raises `KeysError` for a tls/ endpoint at which this machine cannot listen, with the reason."""
    address, colon, port = endpoint.removeprefix("tls/").rpartition(":")
    if not (colon and address and port.isdecimal() and int(port) < 1 << 16):
        raise KeysError(f"{endpoint}: expected tls/<address>:<port>")
    try:
        found = socket.getaddrinfo(address.strip("[]"), int(port), type=socket.SOCK_STREAM)
        with socket.create_server(found[0][4][:2], family=found[0][0]):
            pass
    except OSError as error:
        reasons = {
            errno.EADDRINUSE: f"port {port} is taken: does another run listen there?",
            errno.EADDRNOTAVAIL: f"{address} is no address of this machine",
        }
        why = reasons.get(error.errno or 0, error.strerror or str(error))
        raise KeysError(f"cannot listen at {endpoint}: {why}") from error


def access(machines: Iterable[str], namespace: str, own: str | None = None) -> dict[str, Any]:
    """Returns the access control of a supervisor's machine: a machine gets its own keys and what its processes answer
    with, tools ask and follow, and every other certificate gets nothing. `local_key`s are kept from other machines:
    only tools on this one, and tools with its keys (`own`: their name), ask for them."""
    asking = ["declare_subscriber", "query", "liveliness_query", "declare_liveliness_subscriber"]
    answering = ["put", "reply", "declare_queryable", "liveliness_token"]
    every = [*asking, *answering, "delete"]
    both = {"permission": "allow", "flows": ["ingress", "egress"], "messages": every}
    graph = [f"{namespace}/**", *_runtime_keys(namespace)]
    taps = [runtime_key(namespace, kind, "**") for kind in ("taps", "ack")]
    comes = {"permission": "allow", "flows": ["ingress"]}
    goes = {"permission": "allow", "flows": ["egress"], "messages": every}
    here = local_key(namespace, "**")
    rules = [
        {"id": "asks", **comes, "messages": asking, "key_exprs": [*graph, GRAPH_KEY, OVER_KEY]},
        {"id": "taps", **comes, "messages": answering, "key_exprs": taps},
        {"id": "follows", **goes, "key_exprs": [*graph, GRAPH_KEY, OVER_KEY]},
        {"id": "answers", **comes, "messages": answering, "key_exprs": [*graph, here]},
        {"id": "is asked", **goes, "key_exprs": [here]},
        {"id": "all", **both, "key_exprs": ["**", *graph, here]},
    ]
    tools = ["asks", "taps", "follows"]
    subjects = [
        {"id": "tools", "cert_common_names": [TOOLS]},
        {"id": "here", "link_protocols": ["unixsock-stream"]},
    ]
    policies = [{"rules": tools, "subjects": ["tools"]}, {"rules": ["all"], "subjects": ["here"]}]
    if own is not None:
        rules.append({"id": "orders", **comes, "messages": ["query"], "key_exprs": [here]})
        subjects.append({"id": "own", "cert_common_names": [own]})
        policies.append({"rules": [*tools, "orders", "is asked"], "subjects": ["own"]})
    for name in machines:
        rules.append({"id": name, **both, "key_exprs": [f"{KEYS}/machine/{name}/**"]})
        subjects.append({"id": name, "cert_common_names": [name]})
        policies.append({"rules": [name, *tools, "answers", "is asked"], "subjects": [name]})
    named = {"rules": rules, "subjects": subjects, "policies": policies}
    return {"access_control": {"enabled": True, "default_permission": "deny", **named}}


def _runtime_keys(namespace: str) -> list[str]:
    """Returns the keys of requests: `**` matches no verbatim chunk."""
    return [runtime_key(namespace, "**"), runtime_key(f"{namespace}/**", "**")]
