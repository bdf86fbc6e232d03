"""The documentation builds strictly and is complete."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import horus

ROOT = Path(__file__).parents[2]
TIMEOUT_S = 90


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the site once; warnings are errors."""
    directory = tmp_path_factory.mktemp("site")
    process = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", directory],
        cwd=ROOT,
        # The theme prints an announcement about itself, which no option of mkdocs.yml turns off.
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
        check=False,
    )
    assert process.returncode == 0, process.stderr
    assert "WARNING" not in process.stderr, process.stderr
    return directory


@pytest.mark.parametrize("name", horus.__all__)
def test_reference_has_every_public_name(site: Path, name: str):
    """What `import horus` offers can be looked up."""
    anchor = f'id="horus.{name}"'
    assert any(anchor in page.read_text("utf-8") for page in (site / "reference").rglob("*.html"))


def test_site_needs_no_other_host(site: Path):
    """The documentation can be read where there is no internet."""
    loaded = re.compile(r"<(?:link|script|img)\b[^>]*\b(?:href|src)=\"?(https?:[^\">]+)")
    for page in site.rglob("*.html"):
        assert not loaded.findall(page.read_text("utf-8")), page.relative_to(site)
