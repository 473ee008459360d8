"""`binpick schema`: the cell file's JSON schema, for editors that complete and check YAML."""

import typer


def schema() -> None:
    """Print the JSON schema of cell.yaml (an editor with a YAML plug-in completes and checks the file with it)."""
    from binpick import settings

    typer.echo(settings.schema(), nl=False)
