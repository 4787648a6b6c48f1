"""Verbs that concern this installation: config, warmup."""

from __future__ import annotations

from typing import Annotated

import typer

from mapvote.cli.options import Config
from mapvote.cli.terminal import print_table, waiting


def warmup() -> None:
    """Compile all numba kernels of a vehicle and a server now instead of at their first use. Prints the CPU time.

    mapvote warmup
    """
    with waiting("loading"):
        from mapvote.warmup import warm_up
    steps = warm_up()
    total = 0.0
    while True:
        with waiting("compiling"):
            step = next(steps, None)
        if step is None:
            break
        name, seconds = step
        total += seconds
        print(f"{seconds:6.1f} s  {name}", flush=True)
    print(f"{total:6.1f} s  of CPU time in all; later runs load the kernels from the cache")


def config(
    config: Config = None,
    toml: Annotated[bool, typer.Option("--toml", help="print as TOML, e.g. to start a settings file")] = False,
    all_: Annotated[
        bool, typer.Option("--all", help="also list the numbers of every algorithm, which no setting changes")
    ] = False,
) -> None:
    """Show every setting with its value, where the value comes from, and what it means.

    Settings come from their defaults, then from the TOML file, then from the environment (MAPVOTE_PAPER__N_MIN=4).

        mapvote config --toml > settings.toml
    """
    import tomli_w
    from rich.text import Text

    from mapvote.config import Settings, load_with_sources

    settings, sources = load_with_sources(config)
    if toml:
        print(tomli_w.dumps(settings.model_dump(exclude_none=True)), end="")
        return
    rows: list[list[Text] | None] = []
    for section in Settings.model_fields:
        values = getattr(settings, section)
        for key, field in type(values).model_fields.items():
            source = sources.get(f"{section}.{key}", "default")
            row = f"{section}.{key}", str(getattr(values, key)), source, field.description or ""
            rows.append([Text(cell, "" if source == "default" else "bold green") for cell in row])
        rows.append(None)
    print_table(("setting", "value", "source", "meaning"), rows, "Settings")
    if all_:
        from mapvote.core.extras import missing_extra
        from mapvote.core.record import numbers

        missing: dict[str, ModuleNotFoundError] = {}
        listed = [(number.name, str(number.value), number.meaning) for number in numbers(missing=missing)]
        print_table(("number", "value", "meaning"), listed, "Numbers of the algorithms")
        if missing:
            hints = sorted({missing_extra(error) or str(error) for error in missing.values()})
            print(f"The numbers of {len(missing)} modules are not listed: {'; '.join(hints)}.")
    print(f"Digest {settings.digest()[:16]}: ballots of one round must agree on it.")
