"""`sms rig`: the instruments that are connected to this host."""

from __future__ import annotations

import signal
import sys
from math import degrees, radians
from pathlib import Path
from typing import Annotated

import typer

from sms_jobs import bootstrap
from sms_jobs.app.measuring import rigs
from sms_jobs.cli import output
from sms_jobs.cli.output import Home, Json
from sms_jobs.errors import InvalidInput

app = typer.Typer(help="Rigs: the instruments that are connected to this host.", no_args_is_help=True)

Rig = Annotated[str, typer.Argument(help="Name of the rig.")]
_SIMULATED = "simulated: there when a campaign gives it a scene"


@app.command()
def add(
    file: Annotated[Path | None, typer.Argument(help="Rig file (TOML).")] = None,
    example: Annotated[bool, typer.Option("--example", help="Print a commented file instead.")] = False,
    replace: Annotated[bool, typer.Option("--replace", help="Take it in place of the present one.")] = False,
    home: Home = None,
) -> None:
    """Connect a rig to this host: take over the file that describes its instruments.

    A worker that runs here serves it from now on.

    Example: sms rig add --example > rig.toml; sms rig add rig.toml
    """
    if example:
        sys.stdout.write(rigs.example())
        return
    if file is None:
        raise InvalidInput("name the rig file, or print one with --example")
    with bootstrap.services(home) as services:
        rig = rigs.add(services, file, replace=replace)
    output.say(
        f"rig {rig.name} is connected: {', '.join(rig.devices)}; 'sms rig check {rig.name}' talks to them, "
        "'sms up' or 'sms worker start' serves it, now if it runs"
    )


@app.command("list")
def list_(home: Home = None, as_json: Json = False) -> None:
    """Show the rigs that are connected to this host.

    Example: sms rig list
    """
    with bootstrap.services(home) as services:
        found = rigs.list_rigs(services)
    if as_json:
        output.print_json_list(found)
        return
    output.print_table(
        ["rig", "cameras", "projectors", "other instruments"],
        [
            (
                r.name,
                " ".join(c.name for c in r.cameras),
                " ".join(p.name for p in r.projectors),
                " ".join(d for d in r.devices if d not in r.sensors),
            )
            for r in found
        ],
        empty="no rig is connected to this host; 'sms rig add FILE' takes one",
    )


@app.command()
def show(rig: Rig, home: Home = None) -> None:
    """Print a rig's file.

    Example: sms rig show virtual
    """
    with bootstrap.services(home) as services:
        text = rigs.file_text(services, rig)
    output.print_text(text)


@app.command()
def check(rig: Rig, home: Home = None, as_json: Json = False) -> None:
    """Talk to every instrument of a rig and show what it answers.

    Every projector is lit in turn, and every camera says how bright it is then: a cable in the wrong socket
    is seen at once. Simulated cameras and projectors see a campaign's scene alone, and are only named.

    Example: sms rig check virtual
    """
    with bootstrap.services(home) as services:
        checked = rigs.check(services, rig)
    described, check = checked.rig, checked.check
    sensors = {name: check.sensors.get(name, _SIMULATED) for name in described.sensors}
    cameras = [camera.name for camera in described.cameras]
    ways = {p.name: described.way(p.name, cameras, (1.0,)) for p in described.projectors}
    if as_json:
        pan, tilt = check.stage_rad or (None, None)
        stage = None if check.homed is None else {"pan_rad": pan, "tilt_rad": tilt, "homed": check.homed}
        facts = {"sensors": sensors, "views": check.views, "channels": check.channels, "stage": stage}
        facts["ways"] = ways
        output.print_json({"rig": rig, **facts})
        return
    rows = [*sensors.items(), *ways.items()]
    for name, levels in check.views.items():
        seen = ", ".join(f"{what} {level:.1f}" for what, level in levels.items())
        rows.append((name, f"sees on average {seen} of {check.full_scales[name]}"))
    rows += [(name, f"{value:g} {checked.units[name]}") for name, value in check.channels.items()]
    if described.stage is not None:
        rows.append((described.stage.name, _angles(check.stage_rad, rig)))
    output.print_table(["instrument", "says"], rows, empty="this rig has no instruments")


@app.command("home")
def home_(rig: Rig, home: Home = None) -> None:
    """Bring a rig's stage home, the way it came.

    Example: sms rig home virtual
    """
    with bootstrap.services(home) as services:
        rigs.home_stage(services, rig)
    output.say(f"the stage of {rig} is at home")


@app.command()
def move(
    rig: Rig,
    pan_deg: Annotated[float, typer.Option("--pan", help="Pan angle in degrees.")],
    tilt_deg: Annotated[float, typer.Option("--tilt", help="Tilt angle in degrees.")],
    home: Home = None,
) -> None:
    """Bring a rig's stage to a pose.

    Example: sms rig move virtual --pan 22.5 --tilt -45
    """
    with bootstrap.services(home) as services:
        pan, tilt = rigs.move_stage(services, rig, radians(pan_deg), radians(tilt_deg))
    output.say(f"the stage of {rig} is at pan {degrees(pan):.3f} deg, tilt {degrees(tilt):.3f} deg")


@app.command()
def stop(rig: Rig, home: Home = None) -> None:
    """Stop a rig's stages at once, whoever uses them.

    It asks neither a lock nor the program that moves them. A stage that can hurt somebody needs a switch.

    Example: sms rig stop virtual
    """
    with bootstrap.services(home) as services:
        stopped = rigs.stop(services, rig)
    output.say(f"stopped {', '.join(stopped)}" if stopped else f"rig {rig} has no stage")


@app.command()
def simulate(
    rig: Rig,
    folder: Annotated[Path | None, typer.Option(help="Where a link to each port is made.")] = None,
    home: Home = None,
) -> None:
    """Put simulators of a rig's serial instruments on pseudo-terminals until Ctrl-C.

    Any serial terminal, or another program, can talk to them there.

    Example: sms rig simulate virtual --folder /tmp/virtual
    """
    with bootstrap.services(home) as services:
        # Until the ports are waited for, so that their links are removed however it is ended.
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
        ports = rigs.simulation(services, rig, folder)
    with ports as simulated:
        output.print_table(
            ["instrument", "port", "baud rate"],
            [(p.device, p.path, p.baud_rate) for p in simulated.ports],
            empty="this rig has no serial instruments",
        )
        sys.stdout.flush()
        if simulated.ports:
            signal.sigwait({signal.SIGINT, signal.SIGTERM})


@app.command()
def serve(
    rig: Rig,
    listen: Annotated[
        str, typer.Option(help="Address and port for clients; 0.0.0.0 is every network of this computer.")
    ] = "127.0.0.1:7411",
    key_file: Annotated[
        Path | None,
        typer.Option(
            help="What clients have to know; made if it is missing, by default beside the rig's file."
        ),
    ] = None,
    home: Home = None,
) -> None:
    """Lend the cameras and projectors of a scanner to a client, until Ctrl-C.

    For scanners with a computer of their own: the client's rig file names them with driver = "scanner".
    One client has them at a time; when it is gone, they are dark and still.

    Example: sms rig serve left --listen 192.168.7.11:7411
    """
    output.log_to_stderr()
    with bootstrap.services(home) as services:
        lent = rigs.lend(services, rig, listen, key_file)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    key = lent.key_file.absolute()
    output.say(f"serving scanner {rig} on {lent.server.address}; clients need a copy of {key}")
    lent.server.serve()


def _angles(angles_rad: tuple[float, float] | None, rig: str) -> str:
    if angles_rad is None:
        return f"not homed yet, so that it does not know its angles: 'sms rig home {rig}' looks for them"
    pan, tilt = map(degrees, angles_rad)
    return f"pan {pan:.3f} deg, tilt {tilt:.3f} deg"
