"""The JSON Schema and the documentation come from the models, and agree with the loader."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import jsonschema
import pytest
from ruamel.yaml import YAML

from rsltrace.job.documents.reference import reference
from rsltrace.job.documents.schema import field_schema, job_schema
from rsltrace.job.job import Job
from rsltrace.job.parts.field import FrozenFields, PartField
from rsltrace.job.parts.keys import file_fields, models_in
from rsltrace.job.parts.part import checked
from rsltrace.job.reading.compose import CompositionKeys
from rsltrace.job.values.problem import JobProblem

ROOT = Path(__file__).parents[2]
JOBS = sorted([*ROOT.glob("examples/*/*job*.yaml"), *ROOT.glob("sample_traces/*/*job*.yaml")])
SCHEMA = job_schema()
VALIDATOR = jsonschema.Draft202012Validator(SCHEMA)


def problems(text: str) -> list[str]:
    value = YAML(typ="safe", pure=True).load(text)
    return [error.message for error in VALIDATOR.iter_errors(value)]


def test_the_schema_is_one() -> None:
    jsonschema.Draft202012Validator.check_schema(SCHEMA)


@pytest.mark.parametrize("path", JOBS, ids=lambda path: f"{path.parent.name}-{path.stem}")
def test_every_job_of_the_project_fits(path: Path) -> None:
    assert problems(path.read_text("utf-8")) == []


@pytest.mark.parametrize(
    "text",
    [
        "{nodes: [{node: m:N, parameters: {a: {b: 1}, c: [1.5], d.e: true}}], stop: {duration: 5}}",
        "{nodes: [{node: m:N, name: $(var x)}], vars: {x: a}, seed: $(env SEED 3)}",
        "{base: other.yaml, nodes: [{name: ekf, on_exception: log}], stop: {duration: null}}",
        "{include: more.yaml}",
        "{bags: [a, {path: b, start_offset: 5 ms}], start: 1e3, stop: {topic: /done}}",
        "{nodes: [{node: m:N}], stop: {duration: 100000000000000000000000ns}}",  # too much to say
    ],
)
def test_what_the_loader_takes_fits(text: str) -> None:
    assert problems(text) == []


@pytest.mark.parametrize(
    "text",
    [
        "{}",
        "[]",
        "{nodes: []  , sede: 1}",
        "{nodes: {node: m:N}}",
        "{nodes: [{name: a}]}",
        "{nodes: [{node: m.N}]}",
        "{nodes: [{node: m:N, name: a b}]}",
        "{nodes: [{node: m:N, namespace: x}]}",
        "{nodes: [{node: m:N, parameters: {ros__parameters: {a: 1}}}]}",
        "{nodes: [{node: m:N, parameters: {a: null}}]}",
        "{nodes: [{node: m:N, on_exception: go}]}",
        "{nodes: [{node: m:N}], stop: {duration: 5parsec}}",
        "{nodes: [{node: m:N}], stop: {duration: -1}}",
        "{nodes: [{node: m:N}], stop: {duration: null}}",
        "{nodes: [{node: m:N}], seed: -1}",
        "{nodes: [{node: m:N}], seed: 1.5}",
        "{nodes: [{node: m:N}], timer_ties: none}",
        "{nodes: [{node: m:N}], record: {payloads: 1}}",
        "{bags: [{topics: [/a]}]}",
        "{bags: [{path: a, topics: /a}]}",
    ],
)
def test_what_the_loader_refuses_does_not_fit(text: str) -> None:
    assert problems(text) != []


def fields() -> Iterator[tuple[str, PartField]]:
    models: list[type[FrozenFields]] = [Job, CompositionKeys]
    for model in models:
        for key, field in file_fields(model):
            yield f"{model.__name__}.{key}", field
            models += [inner for inner in models_in(field.annotation) if inner not in models]


FIELDS = dict(fields())


@pytest.mark.parametrize("name", FIELDS)
def test_examples_are_right(name: str) -> None:
    field = FIELDS[name]
    schema = field_schema(field)
    jsonschema.Draft202012Validator.check_schema(schema)
    validator = jsonschema.Draft202012Validator({**schema, "$defs": SCHEMA["$defs"]})
    found: list[JobProblem] = []
    for example in field.examples:
        checked(field, example, found, (), in_file=True)
        validator.validate(example)
    assert found == []


def test_every_key_is_checked() -> None:
    unchecked = [name for name, field in FIELDS.items() if not field.checks]
    assert [name for name in unchecked if not models_in(FIELDS[name].annotation)] == []


def test_every_key_is_described_and_has_an_example() -> None:
    missing = [name for name, field in FIELDS.items() if not (field.description and field.examples)]
    assert missing == []


def test_the_documentation_is_up_to_date() -> None:
    assert (ROOT / "docs" / "jobs.md").read_text("utf-8") == reference(), "run: make docs"


def test_the_command_prints_it() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "rsltrace", "schema"], capture_output=True, text=True, check=True
    )
    assert json.loads(done.stdout) == SCHEMA
