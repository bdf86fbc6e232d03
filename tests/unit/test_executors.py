"""What the supervisor asks of a node that has just been taken out of the schedule."""

from __future__ import annotations

from unittest.mock import Mock

import pytest

from horus.executors.compute import ComputeExecutor
from horus.executors.event import ThreadEventExecutor
from horus.executors.rt import RtExecutor

NOTHING_DUE = Mock(due_ns=Mock(return_value=None))


@pytest.mark.parametrize(
    "executor",
    [
        RtExecutor(Mock(), Mock()),
        ThreadEventExecutor(Mock()),
        ComputeExecutor(Mock(), NOTHING_DUE, Mock()),
    ],
    ids=["Rt", "Event", "Compute"],
)
def test_a_dismissed_node_owes_nothing(executor):
    """It looks at its own pace, and another thread may have dismissed the node meanwhile."""
    gone = Mock()

    assert executor.due_ns(gone, 10**9) is None
    assert executor.thread_id(gone) is None
    executor.isolate(gone)
