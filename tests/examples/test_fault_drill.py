"""The fault drill: every class freezes, raises and overruns, and supervision reacts."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

EXAMPLE = Path(__file__).parents[2] / "examples" / "fault_drill.py"
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
TIMEOUT_S = 60

pytestmark = pytest.mark.realtime


def _run(*arguments: str, cwd: Path, typed: str = "") -> subprocess.CompletedProcess[str]:
    """Run the example as a user would."""
    return subprocess.run(
        [sys.executable, str(EXAMPLE), *arguments],
        cwd=cwd,
        input=typed,
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
        check=False,
    )


@pytest.fixture(scope="module")
def drill(tmp_path_factory: pytest.TempPathFactory) -> tuple[dict[str, Any], Path]:
    """Run some drills; return their JSON, and where the picture is."""
    folder = tmp_path_factory.mktemp("drill")
    picture = folder / "fault_drill.png"
    options = ["--class", "rt", "--class", "urgent", "--class", "async"]
    done = _run(*options, "--json", "--plot", str(picture), cwd=folder)
    assert done.returncode == 0, done.stdout + done.stderr
    return json.loads(done.stdout), picture


def _drills(result: dict[str, Any], fault: str, variant: str) -> list[dict[str, Any]]:
    return [d for d in result["drills"] if d["fault"] == fault and variant in d["variant"]]


def _observed_ms(drill: dict[str, Any], what: str) -> float:
    (check,) = [check for check in drill["checks"] if check["what"] == what]
    observed: float = check["observed_ms"]
    return observed


def test_everything_happens_that_should(drill: tuple[dict[str, Any], Path]) -> None:
    """Eight drills per class pass, and not because nothing was checked."""
    result, _ = drill
    assert result["passed"] is True
    assert len(result["drills"]) == 3 * 8
    assert all(d["passed"] and len(d["checks"]) >= 2 for d in result["drills"])


def test_a_frozen_tick_goes_through_the_stages_in_order(
    drill: tuple[dict[str, Any], Path],
) -> None:
    """Warning, unhealthy, isolated: at one, two and three timeouts, with the place named."""
    drills = _drills(drill[0], "freeze", "isolated")
    assert {d["node"] for d in drills} == {"motor", "estop", "cloud"}
    for one in drills:
        stages = [_observed_ms(one, what) for what in ("warning", "unhealthy", "isolated")]
        assert stages == sorted(stages)
        assert stages[0] > 130
        assert stages[2] > 400
        places = [e["place"] for e in one["events"] if e["text"].startswith("isolated: ")]
        assert re.fullmatch(r"wait_for_\w+\(\), robot\.py:\d+", places[0])


def test_a_critical_node_brings_down_the_whole_robot(drill: tuple[dict[str, Any], Path]) -> None:
    """Every node with a safe-state hook has it called once, in shutdown order."""
    for one in _drills(drill[0], "freeze", "critical"):
        hooks = [event["node"] for event in one["events"] if event["kind"] == "hook"]
        assert hooks == ["cloud", "camera", "planner", "gripper", "motor", "estop"]


def test_skip_drops_a_release_and_warn_does_not(drill: tuple[dict[str, Any], Path]) -> None:
    """After an overrun, `on_miss="skip"` leaves a release out."""
    for one in _drills(drill[0], "overrun", "skip"):
        period_ms = {"motor": 20, "estop": 50, "cloud": 50}[one["node"]]
        assert _observed_ms(one, "ticks again") > period_ms


def test_a_blocked_event_loop_is_blamed_on_who_blocks_it(tmp_path: Path) -> None:
    """The camera freezes on the event loop: it is isolated, and no other node is reported."""
    done = _run("--class", "best_effort", "--fault", "freeze", "--json", cwd=tmp_path)
    checks = {
        c["what"]: c["passed"] for d in json.loads(done.stdout)["drills"] for c in d["checks"]
    }
    assert checks.pop("nobody else blamed")
    assert all(checks.values())


def test_the_picture_is_drawn(drill: tuple[dict[str, Any], Path]) -> None:
    """`--plot` writes a PNG."""
    pytest.importorskip("matplotlib", reason="the picture needs the extra 'examples'")
    assert drill[1].read_bytes().startswith(PNG_SIGNATURE)


def test_a_timeline_and_a_table_are_printed(tmp_path: Path) -> None:
    """Without `--json`, each drill is a timeline, and a table has them all."""
    done = _run("--class", "urgent", "--fault", "raise", cwd=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    assert 'raise estop failure_policy="restart"  [urgent]' in done.stdout
    assert re.search(r"^ +\d+\.\d ms  100 ms \+ release +estop +init", done.stdout, re.MULTILINE)
    assert re.search(r"^  init\(\) again +100 ms \+ release +1\d\d\.\d", done.stdout, re.MULTILINE)
    assert re.search(r"^(\d+) of \1 things happened that should$", done.stdout, re.MULTILINE)


def test_faults_can_be_ordered_by_hand(tmp_path: Path) -> None:
    """Typed commands freeze the motor, are refused while it is frozen, and bring it back."""
    typed = "wait 0.5\nfreeze motor 0.6\nwait 0.3\nclear\nwait 1\nclear\nwait 0.3\nstats\nquit\n"
    done = _run("--interactive", cwd=tmp_path, typed=typed)
    assert done.returncode == 0, done.stdout + done.stderr
    happened = (
        "fault +its tick does not return",
        "CRITICAL +safe state entered: critical node motor",
        "refused +the safe state stays: motor is critical",
        "its frozen tick has ended",
        "tick +ticks again",
        "motor +running +healthy",
        "safe state: no",
    )
    assert re.search(".*".join(happened), done.stdout, re.DOTALL), done.stdout
    # By the thread that clears it, which the motor's need not wait for.
    assert "safe state cleared" in done.stdout


def test_unknown_commands_are_explained(tmp_path: Path) -> None:
    """A typing error stops nothing."""
    done = _run("--interactive", cwd=tmp_path, typed="freeze engine\nraise\nwait 0.1\nstats\n")
    assert done.returncode == 0, done.stderr
    assert "not understood: freeze engine" in done.stdout
    assert "nodes: motor, " in done.stdout
    assert "running     healthy" in done.stdout
