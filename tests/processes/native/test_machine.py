"""What a process finds out about the machine, and draws from it, is the same in every run."""

from __future__ import annotations

import re

import pytest

from tests.processes.native.conftest import Programs

pytestmark = pytest.mark.long


@pytest.mark.parametrize(
    ("name", "out"),
    [
        ("processor", "0 0 0 4 1\n"),
        ("calls", "1700000000 1700000000 2 0 1700000002\n"),
        ("c11", "1 1 600 7 600\n"),
    ],
)
def test_processors_clocks_and_threads_of_c_are_those_of_the_run(
    programs: Programs, name: str, out: str
) -> None:
    ran = programs.run("machine", name)
    assert (ran.out, ran.status) == (out, 0), ran.err


def test_the_bytes_that_the_kernel_gives_a_program_come_from_the_seed(programs: Programs) -> None:
    found = {programs.run("machine", "start").out for _ in range(2)}
    assert len(found) == 1
    assert programs.run("machine", "start", native=True).out not in found


def test_temporary_files_have_the_same_names_in_every_run(programs: Programs) -> None:
    ran = programs.run("machine", "names")
    files = r"/tmp/rsltrace_\w{6}\n\w{6} \w{6}\.txt \w{6} -1\n"
    names = r"/tmp/file\w{6} /tmp/ab\w{6} /tmp/\w{6} no\n"
    assert re.fullmatch(files + names, ran.out), ran
    assert programs.run("machine", "names") == ran
    assert programs.run("machine", "names", native=True).out != ran.out
