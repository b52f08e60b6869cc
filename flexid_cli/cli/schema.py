"""``flexid schema``: the JSON Schemas of what goes in and what comes out."""

from __future__ import annotations

import click

from flexid_cli.cli.options import example


@click.command(
    short_help="Print the JSON Schema of the configuration or the report.",
    epilog=example("flexid schema config > config-1.schema.json"),
)
@click.argument("document", type=click.Choice(["config", "report"]))
def schema(document: str) -> None:
    """Print the JSON Schema (draft 2020-12) of the configuration or of the report.

    An editor that knows YAML language servers completes and checks a configuration that begins with the
    line `# yaml-language-server: $schema=config-1.schema.json`.
    """
    click.echo(_config_schema() if document == "config" else _report_schema(), nl=False)


def _config_schema() -> str:
    import json

    from flexid_cli.config.schema import config_schema

    return json.dumps(config_schema(), indent=2) + "\n"


def _report_schema() -> str:
    from importlib.resources import files

    return files("flexid_cli").joinpath("schemas", "report-1.schema.json").read_text(encoding="utf-8")
