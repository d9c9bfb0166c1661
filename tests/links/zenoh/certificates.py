"""Creates an authority and certificates of hosts with openssl, as links/zenoh/README.md describes."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest


def need_openssl() -> None:
    if shutil.which("openssl") is None:
        pytest.skip("this test needs the openssl command")


def run(*command: str | Path) -> None:
    done = subprocess.run([str(part) for part in command], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def make_authority(folder: Path, name: str = "ca") -> None:
    key = folder / f"{name}.key"
    run("openssl", "genpkey", "-algorithm", "EC", "-pkeyopt", "ec_paramgen_curve:P-256", "-out", key)
    run(
        "openssl",
        "req",
        "-x509",
        "-new",
        "-key",
        key,
        "-days",
        "30",
        "-subj",
        f"/CN={name}",
        "-out",
        folder / f"{name}.pem",
    )


def make_host(
    folder: Path, name: str, address: str | None = None, authority: str = "ca", file: str | None = None
) -> None:
    """`address`: of the hub, the only server."""
    stem = folder / (file or name)
    key, request, extensions = stem.with_suffix(".key"), stem.with_suffix(".csr"), stem.with_suffix(".ext")
    run("openssl", "genpkey", "-algorithm", "EC", "-pkeyopt", "ec_paramgen_curve:P-256", "-out", key)
    run("openssl", "req", "-new", "-key", key, "-subj", f"/CN={name}", "-out", request)
    use = "extendedKeyUsage=clientAuth\n" if address is None else "extendedKeyUsage=clientAuth,serverAuth\n"
    alternative = f"subjectAltName=DNS:{name}" if address is None else f"subjectAltName=DNS:{name},IP:{address}"
    extensions.write_text(f"basicConstraints=CA:FALSE\n{use}{alternative}\n")
    ca = folder / authority
    run(
        "openssl", "x509", "-req", "-in", request, "-CA", ca.with_suffix(".pem"), "-CAkey", ca.with_suffix(".key"),
        "-CAcreateserial", "-days", "30", "-extfile", extensions, "-out", stem.with_suffix(".pem"),
    )  # fmt: skip


def make_all(folder: Path, address: str = "127.0.0.1") -> None:
    """An authority with vehicle (the hub), drone and base, and a second authority with a drone (rogue)."""
    make_authority(folder)
    make_host(folder, "vehicle", address)
    make_host(folder, "drone")
    make_host(folder, "base")
    make_authority(folder, "rogue_ca")
    make_host(folder, "drone", authority="rogue_ca", file="rogue")
