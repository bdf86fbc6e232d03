"""Every piece of Python in the documentation runs and prints what the page says."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import doc_pages
import pytest

pytest_plugins = ["pytester"]

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
LANGUAGES = {"python", "text", "console", "toml", "json"}
TIMEOUT_S = 30


def name_of(page: Path) -> str:
    return str(page.relative_to(ROOT))


def with_code(page: Path) -> bool:
    return any(fence.language == "python" for fence in doc_pages.fences(page.read_text("utf-8")))


def run_page(page: Path, directory: Path) -> list[doc_pages.Result]:
    """Run a page's code in a process of its own, which has to end by itself."""
    process = subprocess.run(
        [sys.executable, doc_pages.__file__, page],
        cwd=directory,
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
        check=False,
    )
    assert process.returncode == 0, process.stderr
    return [doc_pages.Result(**result) for result in json.loads(process.stdout)]


def check_output(where: str, shown: list[str], actual: str, *, figures_vary: bool) -> None:
    fits = doc_pages.shows(
        doc_pages.comparable(shown, figures_vary=figures_vary),
        doc_pages.comparable(actual.splitlines(), figures_vary=figures_vary),
    )
    assert fits, f"{where}\n\n{actual}\nbut the page shows\n\n" + "\n".join(shown)


@pytest.mark.parametrize("page", [page for page in PAGES if with_code(page)], ids=name_of)
def test_code_blocks_run_and_print_what_the_page_shows(page: Path, tmp_path: Path):
    """A reader who types a page in gets what the page promises."""
    results = run_page(page, tmp_path)
    for block, result in zip(doc_pages.blocks(page.read_text("utf-8")), results, strict=False):
        where = f"{name_of(page)}:{result.line}"
        assert not result.error, f"{where} raised\n\n{result.error}"
        vary = block.figures_vary
        check_output(f"{where} printed", block.printed or [], result.printed, figures_vary=vary)
        if block.logged is not None:
            check_output(f"{where} logged", block.logged, result.logged, figures_vary=vary)
        else:
            for sign in ("Traceback", "Warning: "):
                assert sign not in result.logged, f"{where} logged\n\n{result.logged}"


def test_the_tests_on_the_page_about_tests_pass(pytester: pytest.Pytester):
    """Those that take fixtures are only defined when the page's code runs."""
    page = (ROOT / "docs" / "how-to" / "test-a-node.md").read_text("utf-8")
    pytester.makepyfile("\n\n".join(block.code for block in doc_pages.blocks(page)))
    setting = "asyncio_default_fixture_loop_scope=function"
    result = pytester.runpytest_subprocess("-p", "no:cacheprovider", "-o", setting)
    assert result.parseoutcomes() == {"passed": 9}


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_every_block_names_a_known_language(page: Path):
    """No code escapes the tests by being labelled in another way."""
    for fence in doc_pages.fences(page.read_text("utf-8")):
        assert fence.language in LANGUAGES, f"{name_of(page)}:{fence.line}: {fence.language!r}"


@pytest.mark.parametrize(
    ("shown", "actual", "fits"),
    [
        ([], [], True),
        ([], ["a"], False),
        (["a ... z"], ["a b z"], True),
        (["a ... z"], ["a b"], False),
        (["...", "z"], ["a", "b", "z"], True),
        (["a", "...", "z"], ["a", "z"], True),
        (["a", "..."], ["b"], False),
        (["1.5"], ["125"], False),
    ],
)
def test_shown_output_stands_for_actual_output(shown: list[str], actual: list[str], fits: bool):
    """`...` is the only wildcard, in a line and for lines."""
    assert doc_pages.shows(shown, actual) is fits


@pytest.mark.parametrize(
    ("shown", "actual", "figures_vary", "fits"),
    [
        ("12:00:00.000 INFO    @1 a: on", "23:59:59.999 INFO    @7 a: on", False, True),
        ("12:00:00.000 INFO    @1 a: on", "23:59:59.999 INFO    @1 b: on", False, False),
        ("ticks  12.5", "ticks    7", False, False),
        ("ticks  12.5", "ticks    7", True, True),
        ("ticks  12.5", "tacks 12.5", True, False),
    ],
)
def test_what_varies_by_nature_is_not_compared(
    shown: str, actual: str, figures_vary: bool, fits: bool
):
    """Times of day never, numbers only where the page says that they are not."""
    assert fits is doc_pages.shows(
        doc_pages.comparable([shown], figures_vary=figures_vary),
        doc_pages.comparable([actual], figures_vary=figures_vary),
    )


def test_shown_output_belongs_to_the_block_before_it():
    """Output and log are told apart by the title, whatever prose is between."""
    page = '```python\nrun()\n```\nprints\n```text\na\nb\n```\n```text title="log"\nc\n```\n'
    (block,) = doc_pages.blocks(page)
    assert (block.line, block.code) == (2, "run()")
    assert (block.printed, block.logged) == (["a", "b"], ["c"])


@pytest.mark.parametrize(
    "page", ["```text\na\n```", "```python\nrun()\n```\n```text\na\n```\n```text\nb\n```"]
)
def test_output_without_code_is_refused(page: str):
    """Output on a page is somebody's output, or it would go unchecked."""
    with pytest.raises(ValueError, match="no code block"):
        doc_pages.blocks(page)
