"""``flexid completion``: prints what a shell needs to complete commands and options."""

from __future__ import annotations

import click

from flexid_cli.cli.options import example


@click.command(
    short_help="Print the completion script for bash, zsh or fish.",
    epilog=example(
        "flexid completion bash >> ~/.bash_completion",
        "flexid completion zsh > ~/.zfunc/_flexid",
        "flexid completion fish > ~/.config/fish/completions/flexid.fish",
    ),
)
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
def completion(shell: str) -> None:
    """Print the completion script for SHELL; no file is changed.

    bash needs version 4.4 or newer.
    """
    from click.shell_completion import ShellComplete, get_completion_class

    from flexid_cli.cli.main import PROGRAM, main

    script = get_completion_class(shell)
    if script is None:
        message = f"click cannot complete in {shell}"
        raise click.UsageError(message)
    # The base class's source, for bash's own would start a bash to ask its version, and warn.
    click.echo(ShellComplete.source(script(main, {}, PROGRAM, f"_{PROGRAM.upper()}_COMPLETE")), nl=False)
