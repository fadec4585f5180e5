"""Named pipes and devices where a job, or what it names, is read: refused before they are opened.

A pipe that nobody writes to would be waited for without end, and so would the end of /dev/zero.
"""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from rsltrace.adapters.launch.api.parameters import parameters_for
from rsltrace.adapters.launch.expand import expand
from rsltrace.errors import JobError
from rsltrace.guard.audit.audit import audit_path
from rsltrace.job import job_from_text, load_job
from rsltrace.run.plans.entries import node_entries

pytestmark = pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes")

_NODES = "nodes: [{main: nothing:main}]\n"
_JOBS = {
    "base": "base: %s\n" + _NODES,
    "include": "include: [%s]\n" + _NODES,
    "a parameter file": "nodes: [{main: nothing:main, parameter_files: [%s]}]\n",
    "a parameter file of all": "ros_arguments: [--params-file, %s]\n" + _NODES,
    "a file of delays": "delay: {topics: {/scan: {samples: {file: %s}}}}\n" + _NODES,
    "a launch file": "launch: [%s]\n",
    "a script": "nodes: [{script: %s}]\n",
}
"""Jobs that name one, by what it should be."""


@pytest.fixture(params=["pipe", "/dev/zero"])
def none(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """What is no file: a pipe without a writer, a device without an end."""
    place = tmp_path / str(request.param)
    if request.param == "pipe":
        os.mkfifo(place)
    return place


@pytest.mark.parametrize("text", _JOBS.values(), ids=_JOBS)
def test_what_a_job_names(text: str, none: Path, tmp_path: Path) -> None:
    with pytest.raises(JobError, match=rf"{none}.* not a"):
        node_entries(job_from_text(text % none, "job.yaml", tmp_path))


def test_the_job_itself(none: Path) -> None:
    with pytest.raises(JobError, match=rf"{none}.*not a regular file"):
        load_job(none)


@pytest.mark.parametrize("name", ["a.launch.xml", "b.launch.yaml"])
def test_what_a_launch_file_names(name: str, none: Path, tmp_path: Path) -> None:
    place = tmp_path / name
    place.write_text(
        f'<launch><include file="{none}"/></launch>'
        if name.endswith("xml")
        else f"launch:\n- include: {{file: {none}}}\n"
    )
    job = job_from_text(f"launch: [{name}]\n", "job.yaml", tmp_path)
    with pytest.raises(JobError, match="not a regular file"):
        expand(job, why_not=lambda *_: None, is_process=lambda *_: False)
    with pytest.raises(JobError, match="not a regular file"):
        parameters_for(str(none), "/node")


def test_a_source_to_look_into(none: Path) -> None:
    (trouble,) = audit_path(none).troubles
    assert trouble.endswith("not a regular file")
