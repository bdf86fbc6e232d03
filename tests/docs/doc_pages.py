"""Read the Markdown pages: their code blocks, and the output that they show.

A page's ```python blocks run in order in one namespace. A ```text block shows what the
```python block before it printed, and a ```text block with `title="log"` what it logged. A
block that prints has to show it. `...` stands for what varies: within a line for any text,
alone on a line for any number of lines. Times of day and cycle numbers in a log are not
compared, and neither are the numbers in a block with `title="figures vary"`.

Run as a program, this module executes the blocks of one page and reports them as JSON.
"""

from __future__ import annotations

import contextlib
import io
import json
import re
import sys
import traceback
import types
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

_FENCE = re.compile(r"(?P<indent> *)(?P<marks>`{3,})(?P<language>[\w-]*) *(?P<info>.*)")
_STAMP = re.compile(r"^\d\d:\d\d:\d\d\.\d\d\d (\w+ +)(?:@\d+ )?")
_NUMBER = re.compile(r"\d+(?:\.\d+)?")
_LOG = 'title="log"'
_FIGURES_VARY = 'title="figures vary"'


@dataclass(frozen=True, slots=True, kw_only=True)
class Fence:
    """A fenced block as it is written."""

    language: str
    info: str
    line: int
    """The line of the page that its text begins on."""
    text: str


@dataclass(slots=True, kw_only=True)
class Block:
    """A piece of code, and what the page says about its output."""

    line: int
    code: str
    printed: list[str] | None = None
    logged: list[str] | None = None
    figures_vary: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Result:
    """What happened when a block ran."""

    line: int
    printed: str
    logged: str
    error: str


def fences(markdown: str) -> Iterator[Fence]:
    """Yield the fenced blocks of a page."""
    lines = enumerate(markdown.splitlines(), start=1)
    for number, line in lines:
        opening = _FENCE.fullmatch(line)
        if opening is None:
            continue
        indent, marks = opening["indent"], opening["marks"]
        body = []
        for _, inner in lines:
            if inner.strip() == marks:
                break
            body.append(inner.removeprefix(indent))
        else:
            raise ValueError(f"the block that begins on line {number} does not end")
        yield Fence(
            language=opening["language"],
            info=opening["info"],
            line=number + 1,
            text="\n".join(body),
        )


def blocks(markdown: str) -> list[Block]:
    """Return the code of a page, each block with the output shown for it."""
    found: list[Block] = []
    for fence in fences(markdown):
        if fence.language == "python":
            found.append(Block(line=fence.line, code=fence.text))
        elif fence.language == "text":
            attribute = "logged" if _LOG in fence.info else "printed"
            if not found or getattr(found[-1], attribute) is not None:
                raise ValueError(f"no code block has the output shown on line {fence.line}")
            setattr(found[-1], attribute, fence.text.splitlines())
            found[-1].figures_vary |= _FIGURES_VARY in fence.info
    return found


def shows(shown: list[str], actual: list[str]) -> bool:
    """Return whether the output that a page shows stands for the actual one."""
    if not shown:
        return not actual
    if shown[0] == "...":
        return any(shows(shown[1:], actual[start:]) for start in range(len(actual) + 1))
    if not actual:
        return False
    pattern = ".*".join(re.escape(piece) for piece in shown[0].split("..."))
    return re.fullmatch(pattern, actual[0]) is not None and shows(shown[1:], actual[1:])


def comparable(lines: Iterable[str], *, figures_vary: bool = False) -> list[str]:
    """Return lines of output without what is never compared."""
    compared = [_STAMP.sub(r"\1", line).rstrip() for line in lines]
    if not figures_vary:
        return compared
    # The width of a table's column goes with its numbers.
    return [re.sub(r"-{2,}| +", " ", _NUMBER.sub("0", line)) for line in compared]


def run(page: Path) -> list[Result]:
    """Run the blocks of a page until one raises."""
    module = types.ModuleType("__main__")
    # Dataclasses and pickles look their module up by its name.
    sys.modules["__main__"] = module
    results = []
    for block in blocks(page.read_text(encoding="utf-8")):
        # Line numbers in a traceback are those of the page.
        code = compile("\n" * (block.line - 1) + block.code, str(page), "exec")
        error = ""
        with (
            contextlib.redirect_stdout(io.StringIO()) as printed,
            contextlib.redirect_stderr(io.StringIO()) as logged,
        ):
            try:
                exec(code, module.__dict__)
            except Exception:
                error = traceback.format_exc()
        results.append(
            Result(
                line=block.line,
                printed=printed.getvalue(),
                logged=logged.getvalue(),
                error=error,
            )
        )
        if error:
            break
    return results


if __name__ == "__main__":
    json.dump([asdict(result) for result in run(Path(sys.argv[1]))], sys.stdout)
