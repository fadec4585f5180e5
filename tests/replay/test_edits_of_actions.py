"""What if a goal, an answer, feedback, a result or a cancel request had been another one?"""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

import rsltrace
from rsltrace.errors import EditError
from rsltrace.job import load_job
from rsltrace.run import run
from rsltrace.trace.model.entity import EntityKind
from rsltrace.trace.model.event import EventKind
from rsltrace.trace.reader import Trace
from tests.replay.test_edits import branch
from tests.replay.test_jobs_replay import ROOT

pytestmark = [
    pytest.mark.ros,
    pytest.mark.skipif(
        importlib.util.find_spec("test_msgs") is None, reason="needs ROS 2's test_msgs"
    ),
]

PROGRAMS = ("fibonacci_server", "fibonacci_client", "camera", "camera_manager")
SERVER, CLIENT, HEARD = EntityKind.SERVICE, EntityKind.CLIENT, EntityKind.SUBSCRIPTION


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the trace of a job with an action and a lifecycle node, all of them mains."""
    folder = tmp_path_factory.mktemp("actions")
    nodes = "".join(f"  - {{main: demo_interactions.{name}:main}}\n" for name in PROGRAMS)
    path = ROOT / "tests/demos/demo_interactions"
    (folder / "job.yaml").write_text(
        f"nodes:\n{nodes}search_path: [{path}]\nstop: {{duration: 5s}}\n"
    )
    run(load_job(folder / "job.yaml"), folder / "run.mcap")
    return folder


def said(path: Path) -> list[str]:
    """Return what the nodes have logged."""
    with Trace.open(path) as trace:
        return [trace.decode("/rosout", data).msg for _, _, data in trace.messages("/rosout")]  # type: ignore[attr-defined]


def event(path: Path, kind: EventKind, end: EntityKind, name: str, nth: int = 0) -> int:
    """Return the index of the nth event of that kind, of an entity of that kind and name."""
    with Trace.open(path) as trace:
        found = []
        for index in range(trace.event_count):
            one = trace.event(index)
            entity = trace.entity(one.entity)
            if (one.kind, entity.kind, entity.name) == (kind, end, name):
                found.append(index)
        return found[nth]


CASES = {
    "a goal": (SERVER, "send_goal", 1, "message.goal.order = 3", "5: succeeded [0, 1, 1, 2]"),
    "a goal that is refused": (SERVER, "send_goal", 1, "message.goal.order = 50", "5: rejected"),
    "a goal that is not": (SERVER, "send_goal", 0, "message.goal.order = 2", "99: succeeded"),
    "an answer": (CLIENT, "send_goal", 1, "message.accepted = False", "5: rejected"),
    "a result": (
        CLIENT,
        "get_result",
        0,
        "message.result.sequence = [7]",
        "5: succeeded [7]",
    ),
    "feedback": (
        HEARD,
        "feedback",
        1,
        "message.feedback.sequence = [9, 9]",
        "5: feedback [[0, 1, 1], [9, 9],",
    ),
    "no feedback": (HEARD, "feedback", 0, "drop()", "5: feedback [[0, 1, 1, 2],"),
    "a cancel request": (
        SERVER,
        "cancel_goal",
        0,
        "message.goal_info.goal_id.uuid[0] += 1",
        "9: 0 to be cancelled",
    ),
}
USUAL = ("a goal", "a result", "no feedback")


@pytest.mark.few(3)
@pytest.mark.parametrize(
    "case", [one if one in USUAL else pytest.param(one, marks=pytest.mark.long) for one in CASES]
)
def test_what_arrives_for_an_action(case: str, folder: Path) -> None:
    end, name, nth, edit, expected = CASES[case]
    at = event(folder / "run.mcap", EventKind.ACTION, end, f"/fibonacci/_action/{name}", nth)
    assert not any(expected in one for one in said(folder / "run.mcap"))
    result = branch(folder, f"{at}: {edit}")
    assert result.verified == at
    assert any(expected in one for one in said(folder / "branch.mcap")), said(
        folder / "branch.mcap"
    )


@pytest.mark.long
def test_what_an_action_publishes(folder: Path) -> None:
    topic = "/fibonacci/_action/feedback"
    branch(folder, f'0.5s: topic("{topic}").feedback.sequence = [8]')
    assert any("[8]" in one for one in said(folder / "branch.mcap"))
    branch(folder, f'0.5s: drop("{topic}")')


@pytest.mark.long
def test_nobody_answers_a_goal(folder: Path) -> None:
    """Then the client waits for ever, and that is how the branch ends."""
    at = event(folder / "run.mcap", EventKind.ACTION, SERVER, "/fibonacci/_action/send_goal", 1)
    result = branch(folder, f"{at}: drop()")
    assert not any("5: succeeded" in one for one in said(folder / "branch.mcap"))
    assert result.diff is not None


@pytest.mark.long
@pytest.mark.parametrize("edit", ["message.transition.id = 99", "drop()"])
def test_a_transition_of_a_lifecycle(edit: str, folder: Path) -> None:
    at = event(folder / "run.mcap", EventKind.SERVICE, SERVER, "/camera/change_state")
    result = branch(folder, f"{at}: {edit}")
    assert result.verified == at


@pytest.mark.long
@pytest.mark.parametrize("edit", ["delay('5ms')", "defer()"])
def test_what_the_executor_of_a_main_runs_cannot_be_late(edit: str, folder: Path) -> None:
    at = event(folder / "run.mcap", EventKind.SERVICE, SERVER, "/camera/change_state")
    with pytest.raises(EditError, match="an executor of its program runs it"):
        branch(folder, f"{at}: {edit}")


@pytest.mark.parametrize(
    ("edit", "why"),
    [
        ("message.goal.oder = 3", "has no goal.oder"),
        ("delay('5ms')", "cannot run later"),
        ("defer()", "cannot run later"),
    ],
)
def test_what_cannot_be(
    edit: str, why: str, folder: Path, recwarn: pytest.WarningsRecorder
) -> None:
    at = event(folder / "run.mcap", EventKind.ACTION, SERVER, "/fibonacci/_action/send_goal")
    with pytest.raises(EditError, match=why):
        rsltrace.replay(folder / "run.mcap", edits=f"{at}: {edit}", trust=True)
    assert not [one for one in recwarn if "never awaited" in str(one.message)]


@pytest.mark.long
def test_in_a_session(folder: Path) -> None:
    at = event(folder / "run.mcap", EventKind.ACTION, SERVER, "/fibonacci/_action/send_goal", 1)
    with rsltrace.DebugSession(folder / "run.mcap", job_folder=folder, trust=True) as session:
        session.go_to(at)
        assert session.edit("message.goal.order = 3").index == at
        session.go_on()
        assert session.reverse_step().position.index == session.events - 1  # type: ignore[operator]
        session.branch(folder / "kept.mcap", force=True)
    assert "5: succeeded [0, 1, 1, 2]" in said(folder / "kept.mcap")
    assert rsltrace.replay(folder / "kept.mcap", job_folder=folder, trust=True).is_whole
