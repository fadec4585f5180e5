"""``rsltrace schema``: the JSON Schema of job files, for editors."""

from __future__ import annotations

import json

import click

from rsltrace.terminal import say


@click.command()
def schema() -> None:
    """Print the JSON Schema (draft 2020-12) of job files.

    \b
    For completion and checks in VS Code (with Red Hat's YAML extension) and other editors, run
      rsltrace schema > job.schema.json
    and put this line at the top of the job file:
      # yaml-language-server: $schema=job.schema.json
    """
    say(schema_text())


def schema_text() -> str:
    from rsltrace.job.documents.schema import job_schema

    return json.dumps(job_schema(), indent=2)
