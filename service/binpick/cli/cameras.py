"""`binpick cameras`: which cameras answer, what they say of themselves, and that as a file to send."""

import json
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from binpick.errors import CameraError, CameraNotFound, InputError

if TYPE_CHECKING:
    from binpick.camera.description import Description, Feature, Found
    from binpick.host import Host

cameras = typer.Typer(name="cameras", no_args_is_help=True,
                      help="Which cameras answer, and what they say of themselves. Changes nothing, and disturbs no daemon.")
Address = Annotated[str, typer.Argument(help="IPv4 address of a camera; left out: every camera that answers a broadcast.")]
LIBRARIES = ("numpy", "opencv-contrib-python-headless", "open3d-cpu", "open3d", "scipy", "pydantic", "pymodbus")
NOBODY = ("no camera answers a broadcast: check its power (PoE, or the plug) and cable, that this host's port has an address "
          "in the camera's subnet (cameras without one of their own use 169.254.0.0/16), and the firewall; "
          "`binpick check --host --cell FILE` looks at these")


@cameras.command("list")
def list_(as_json: Annotated[bool, typer.Option("--json", help="Print the list as JSON.")] = False) -> None:
    """Every GigE Vision camera that answers on any port of this machine: address, serial number, who controls it.

    Exit code 3: none answers.
    """
    from binpick import host

    here = host.read()
    rows = [_row(found, here) for found in _discovered()]
    if as_json:
        typer.echo(json.dumps(rows, indent=1))
        return
    typer.echo("\n".join(_aligned([tuple(rows[0]), *(tuple(row.values()) for row in rows)])))


@cameras.command()
def values(address: Address = "",
           grep: Annotated[str, typer.Option(help="Only features whose name matches this regular expression, "
                                                  "in either case.")] = "") -> None:
    """What every feature is set to, its unit, what may be written to it, and whether it may be."""
    from binpick.camera import backends

    try:
        wanted = re.compile(grep, re.IGNORECASE)
    except re.error as error:
        raise InputError(f"--grep {grep!r} is no regular expression: {error}") from error
    for description in map(backends.describe, _addresses(address)):
        who = (description.value("DeviceModelName"), description.value("DeviceSerialNumber"), f"at {description.address}")
        held = ", controlled by another program" if description.controlled else ""
        typer.echo(" ".join(word for word in who if word) + held)
        typer.echo("\n".join(_table(feature for feature in description.features if wanted.search(feature.name))) + "\n")


@cameras.command()
def dump(address: Address = "",
         out: Annotated[Path | None, typer.Option(help="The zip file; left out: binpick-cameras-<time>.zip in this "
                                                       "folder.")] = None) -> None:
    """Write one zip file with all that a maintainer asks for: GenICam descriptions, feature values, versions, this host.

    It holds serial numbers, network addresses and no images. Exit code 3: a camera could not be read; the file says which.
    """
    from binpick import host
    from binpick.camera import backends

    addresses = _addresses(address)
    path = out or Path(f"binpick-cameras-{datetime.now(UTC):%Y%m%d-%H%M%S}.zip")
    here = host.look()
    files: dict[str, str | bytes] = {"host.json": json.dumps(asdict(here), indent=1),
                                     "versions.json": json.dumps(_versions(), indent=1)}
    failed: list[str] = []
    for number, one in enumerate(addresses, start=1):
        typer.echo(f"{number} of {len(addresses)}: reading {one} ...", err=True)
        try:
            description = backends.describe(one)
        except CameraError as error:
            failed.append(one)
            files[f"{one}/error.txt"] = f"{error}\n"
            typer.echo(f"  {error}", err=True)
        else:
            files |= _files(description)
            typer.echo(f"  {len(description.features)} features", err=True)
    _zip(path, files)
    typer.echo(f"written: {path.resolve()} ({path.stat().st_size / 1e3:.0f} kB)")
    if failed:
        raise CameraError(f"{path} lacks what could not be read of {', '.join(failed)}")


def _discovered() -> "tuple[Found, ...]":
    """Raises CameraNotFound when there is none, CameraError without Aravis."""
    from binpick.camera import backends

    found = backends.discover()
    if not found:
        raise CameraNotFound(NOBODY)
    return found


def _addresses(address: str) -> list[str]:
    return [address] if address else [found.address for found in _discovered()]


def _row(found: "Found", here: "Host") -> dict[str, str]:
    from binpick.camera import probe

    way, held_by = here.way(found.address), probe.controller(found.address)
    port = "" if way is None or way.gateway else way.port
    if held_by is None:
        control = "out of reach: another subnet?" if not port else "does not answer"
    else:
        control = f"held by {held_by}" if held_by else "free"
    return {"address": found.address, "serial": found.serial, "vendor": found.vendor, "model": found.model, "mac": found.mac,
            "port": port, "control": control}


def _aligned(rows: Sequence[Sequence[str]]) -> Iterator[str]:
    """Lines of columns, two blanks between; no frame, for grep and cut."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows)


def _table(features: "Iterable[Feature]") -> Iterator[str]:
    rows = [(feature.name, feature.access, feature.shown, feature.range) for feature in features]
    return _aligned([("feature", "access", "value", "may be"), *rows])


def _versions() -> dict[str, str]:
    import platform
    from importlib import metadata

    from binpick import __version__
    from binpick.camera import backends

    found = {"binpick": __version__, "python": platform.python_version(), "platform": platform.platform(),
             "aravis": backends.version()}
    for library in LIBRARIES:
        try:
            found[library] = metadata.version(library)
        except metadata.PackageNotFoundError:
            continue
    return found


def _files(description: "Description") -> dict[str, str | bytes]:
    folder, facts = description.address, asdict(description)
    del facts["genicam_xml"]
    return {f"{folder}/genicam.xml": description.genicam_xml,
            f"{folder}/values.txt": "\n".join(_table(description.features)) + "\n",
            f"{folder}/features.json": json.dumps(facts, indent=1)}


def _zip(path: Path, files: dict[str, str | bytes]) -> None:
    """Raises InputError when it cannot be written."""
    import zipfile

    try:
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            for name, content in files.items():
                archive.writestr(f"{path.stem}/{name}", content)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from error
