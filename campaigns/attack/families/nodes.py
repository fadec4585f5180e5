"""Misbehaving nodes: a library of mischief, one or a few of it at a time."""

from __future__ import annotations

import json
from collections.abc import Sequence
from random import Random

from campaigns.attack import oracle
from campaigns.attack.corpus import Corpus, put_robot
from campaigns.attack.families import recordings
from campaigns.attack.families.common import Attack, Family
from campaigns.attack.model import Case, Command, Complaint, Limits, Ran, Wrong

_JOB = """\
nodes:
  - {node: robot:Driver}
  - {node: mischief:Mischief, arguments: {plan: %s}}
  - node: robot:Arm
stop: {duration: 500ms}
record: {segment_events: 16}
"""
_LIMITS = Limits(cpu_s=12, rss_mib=900)

_GROUPS: dict[str, str] = {
    "descriptors": "close_descriptors close_and_take dup2_over_all no_descriptors",
    "streams": "close_stdout close_stderr replace_stdout broken_stdout closed_stdout",
    "forks": "fork_and_go_on fork_and_exit fork_and_raise fork_and_sys_exit popen "
    "process_of_multiprocessing",
    "output": "delete_output rename_output truncate_output replace_output append_to_output "
    "overwrite_output delete_folder",
    "surroundings": "chdir umask small_files clears_environment",
    "ends": "exit_at_once exit_zero_at_once abort segfault kill_self",
    "signals": "terminate_self hang_up_self interrupt_self set_timer set_alarm profile_timer "
    "handlers",
    "exceptions": "raises raises_escapes raises_unprintable raises_group sys_exit sys_exit_text "
    "keyboard_interrupt generator_exit memory_error recursion recursion_of_data no_super",
    "misuse": "negative_period nan_period huge_period zero_period wrong_field wrong_type "
    "wrong_attribute surrogates not_a_message bad_names bad_parameter another_node strange_repr "
    "array_of_wrong_kind",
    "floods": "nan_message huge_message many_messages many_logs log_escapes many_entities",
    "graph": "shut_down destroy_self destroy_publisher executor_inside sleeps",
    "threads": "thread_that_raises thread_that_waits",
    "interpreter": "raises_at_exit raises_when_collected no_collector breaks_open breaks_os_write "
    "breaks_modules breaks_hash excepthook settrace",
}
_WHERE = ("constructor", "timer", "timer", "message", "destroy")

_SIGNALS_OF = {
    "abort": {-6, 134},
    "segfault": {-11},
    "kill_self": {-9, 137},
    "set_timer": {-14},  # of its own, if a slow machine takes longer than it to close the run
    "terminate_self": {143},
    "hang_up_self": {129},
    "interrupt_self": {130},
    "keyboard_interrupt": {130},
    "exit_at_once": {7},
    "sys_exit": {5},
    "sys_exit_text": {1},
    "profile_timer": {-27},
    "memory_error": set(),
    "closed_stdout": {1, 120},
}
_TAMPERING = frozenset(_GROUPS["output"].split())
_TAKING = frozenset(
    "delete_output rename_output replace_output truncate_output delete_folder".split()
)
_UNANNOUNCED = frozenset(
    "exit_at_once exit_zero_at_once abort segfault kill_self profile_timer".split()
)
"""After these nobody can say anything; what counts is what is left on the disk."""


def _attack(what: str) -> Attack:
    def attack(rng: Random, case: Case, corpus: Corpus) -> None:
        steps = [_step(rng, what)]
        if rng.random() < 0.15:
            other = rng.choice(list(_GROUPS))
            steps.append(_step(rng, rng.choice(_GROUPS[other].split())))
        attack_with(rng, case, corpus, steps)

    return attack


def _step(rng: Random, what: str) -> dict[str, object]:
    if what == "no_super":
        return {"where": "before", "what": what, "at": 0}
    if what == "set_timer":  # short: it must not outlive the run
        return {"where": "destroy", "what": what, "at": 0}
    if rng.random() < 0.1:
        return {"where": "before", "what": what, "at": 0}
    return {"where": rng.choice(_WHERE), "what": what, "at": rng.choice((1, 3, 12))}


def attack_with(
    rng: Random, case: Case, corpus: Corpus, steps: Sequence[dict[str, object]]
) -> None:
    """Record the robot with a node that does ``steps``."""
    folder = case.folder
    put_robot(folder, "mischief.py")
    (folder / "job.yaml").write_text(_JOB % json.dumps(list(steps)))
    old = ""
    words = ["record", "job.yaml", "-o", recordings.OUTPUT]
    if rng.random() < 0.5:
        (folder / recordings.OUTPUT).write_bytes(corpus.robot)
        old = recordings.fingerprint(case)
        words.append("--force")
    done = {str(step["what"]) for step in steps}
    allowed = set(oracle.RECORDING)
    for what in done:
        allowed |= _SIGNALS_OF.get(what, set())
    fresh = rng.random() < 0.12
    if not fresh:
        words.append("--no-pin")
    case.user_code = True
    case.names = ("mischief", "job.yaml", recordings.OUTPUT)
    if "no_descriptors" in done:  # whatever is opened next is named
        case.names += ("Too many open files",)
    quiet_streams = done & set(_GROUPS["streams"].split())
    case.commands.append(
        Command(
            tuple(words),
            frozenset(allowed),
            folder,
            fresh=fresh,
            limits=_LIMITS,
            stderr="lost" if quiet_streams or done & _UNANNOUNCED else "file",
        )
    )
    case.note = ", ".join(f"{step['what']} in {step['where']}" for step in steps)
    case.judge = lambda runs: _judge(case, runs, old, steps)


def _judge(
    case: Case, runs: Sequence[Ran], old: str, steps: Sequence[dict[str, object]]
) -> list[Complaint]:
    done = {str(step["what"]) for step in steps}
    found: list[Complaint] = []
    if not (done & _UNANNOUNCED and runs[-1].status in (0, 7)):
        found += recordings.judge(
            case,
            runs,
            old=old,
            tampers=bool(done & _TAMPERING),
            whole_if=frozenset((129, 130, 143)) if len(steps) == 1 else frozenset(),
        )
    mine = case.folder / "mine.txt"
    if mine.exists() and mine.read_bytes() not in (b"", b"mine"):
        text = f"{mine.stat().st_size} bytes were written into a file of the node's"
        found.append(Complaint(Wrong.LOST, text, runs[-1].line))
    return found


_SLICE = (
    "close_descriptors close_and_take dup2_over_all closed_stdout fork_and_go_on fork_and_raise "
    "delete_output truncate_output replace_output overwrite_output chdir small_files segfault "
    "hang_up_self raises_escapes sys_exit recursion no_super negative_period "
    "wrong_field destroy_publisher log_escapes"
)

FAMILY = Family(
    "nodes",
    {what: _attack(what) for group in _GROUPS.values() for what in group.split()},
    sliced=frozenset(_SLICE.split()),
    ros=True,
)
