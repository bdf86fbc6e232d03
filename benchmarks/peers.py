"""Make interpreters that have a comparable package installed, in a cache below the checkout."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import venv
from dataclasses import dataclass
from typing import TYPE_CHECKING

from benchmarks.harness import REPOSITORY

if TYPE_CHECKING:
    from pathlib import Path

CACHE = REPOSITORY / ".bench"


class PeerError(RuntimeError):
    """A peer package could not be installed; the message says what was tried and what was said."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Peer:
    """A package from the registry, pinned to the version that the published figures are about."""

    distribution: str
    version: str
    companions: tuple[str, ...] = ()
    """Further requirements, pinned, that the package does not pull in itself."""

    @property
    def requirement(self) -> str:
        """Return the pinned requirement as pip takes it."""
        return f"{self.distribution}=={self.version}"

    @property
    def label(self) -> str:
        """Return the name in tables."""
        return f"{self.distribution} {self.version}"

    def interpreter(self, cache: Path = CACHE) -> Path:
        """Return the interpreter of this peer's virtual environment, making it on first use.

        A marker file is written last, so that an interrupted install is not mistaken for a
        finished one.

        Raises:
            PeerError: If the environment cannot be made or pip cannot install the package.
        """
        tag = f"py{sys.version_info.major}{sys.version_info.minor}"
        home = cache / f"{self.distribution}-{self.version}-{tag}"
        python = home / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
        complete = home / "complete"
        if complete.exists() and python.exists():
            return python
        cache.mkdir(parents=True, exist_ok=True)
        # The cache keeps itself out of version control, wherever it is put.
        (cache / ".gitignore").write_text("*\n", encoding="utf-8")
        shutil.rmtree(home, ignore_errors=True)
        try:
            venv.create(home, with_pip=True)
        except (OSError, subprocess.CalledProcessError) as error:
            raise PeerError(f"cannot make a virtual environment in {home}: {error}") from error
        pip = [python, "-m", "pip", "install", "--disable-pip-version-check"]
        install = subprocess.run(
            [*pip, self.requirement, *self.companions],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            check=False,
        )
        if install.returncode != 0:
            tail = "\n".join(install.stderr.strip().splitlines()[-5:])
            raise PeerError(f"pip could not install {self.requirement} into {home}:\n{tail}")
        complete.touch()
        return python


HORUS_ROBOTICS = Peer(distribution="horus-robotics", version="0.4.1")
DORA = Peer(distribution="dora-rs", version="1.1.0", companions=("dora-rs-cli==1.1.0",))
