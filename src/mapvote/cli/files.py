"""The verbs for files: config."""

from __future__ import annotations

import typer

from mapvote.cli.options import Config


def register(app: typer.Typer) -> None:
    app.command("config")(config)


def config(
    config: Config = None,
    toml: bool = typer.Option(False, "--toml", help="Print as TOML, to start a settings file from"),
) -> None:
    """Show every setting with its value, where the value comes from, and what it means.

    Settings come from their defaults, then from the TOML file, then from the environment (MAPVOTE_VOTING__N_MIN=4).
    """
    import tomli_w
    from rich.console import Console
    from rich.table import Table

    from mapvote.config import Settings, load_with_sources

    settings, sources = load_with_sources(config)
    if toml:
        typer.echo(tomli_w.dumps(settings.model_dump(exclude_none=True)), nl=False)
        return
    table = Table(title="Settings", title_justify="left", header_style="bold")
    for heading in ("setting", "value", "source", "meaning"):
        table.add_column(heading, overflow="fold")
    for section in Settings.model_fields:
        values = getattr(settings, section)
        for key, field in type(values).model_fields.items():
            source = sources.get(f"{section}.{key}", "default")
            style = "" if source == "default" else "bold green"
            table.add_row(f"{section}.{key}", str(getattr(values, key)), source, field.description or "", style=style)
        table.add_section()
    console = Console()
    console.print(table)
    console.print(f"Digest {settings.digest()[:16]}: ballots of one round must agree on it.", highlight=False)
