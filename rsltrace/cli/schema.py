"""``rsltrace schema``: what editors need to complete and check a job file."""

from __future__ import annotations

import json

import click

from rsltrace.terminal import say


@click.command()
def schema() -> None:
    """Print the JSON Schema (draft 2020-12) of a job file.

    \b
    Completion and checks in VS Code (with the YAML extension by Red Hat) and other editors:
      rsltrace schema > job.schema.json
    and as the first line of the job file:
      # yaml-language-server: $schema=job.schema.json
    """
    say(schema_text())


def schema_text() -> str:
    """Return the JSON Schema of a job file."""
    from rsltrace.job.documents.schema import job_schema

    return json.dumps(job_schema(), indent=2)
