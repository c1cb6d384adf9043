"""Commands and their options."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from tools.cli.exits import ended_in_order

app = typer.Typer(
    name="dualcal",
    help="Find where two robot arms stand to each other and where the camera sits on its flange.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)

Cell = Annotated[Path, typer.Argument(metavar="CELL", help="The cell file (YAML).", show_default=False)]
Set = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="PATH=VALUE", help="Override a value of the cell file; may be repeated."),
]
Method = Annotated[str | None, typer.Option(help="Estimator; overrides procedure.method.")]
Json = Annotated[bool, typer.Option("--json", help="Print result.json alone on standard output.")]


class Noise(StrEnum):
    """Where the refined method has its sigmas from."""

    STATED = "stated"
    ESTIMATE = "estimate"


class Procedure(StrEnum):
    """As ``dualcal_hal.session.conduct`` has them."""

    CALIBRATION = "calibration"
    INTRINSICS = "intrinsics"


@app.command()
def run(
    cell: Annotated[
        Path | None,
        typer.Argument(metavar="[CELL]", help="The cell file (YAML); a session brings its own.", show_default=False),
    ] = None,
    resume: Annotated[
        Path | None, typer.Option("--resume", metavar="SESSION", help="Go on with a session that was interrupted.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Session folder. Default: sessions/<time>-<cell>.")] = None,
    procedure: Annotated[
        Procedure | None, typer.Option(help="What to run; intrinsics are the camera's matrix and distortion.")
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Sets procedure.seed and simulation.seed.")] = None,
    method: Method = None,
    overrides: Set = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Show stand-off, looks and a provisional plan only.")
    ] = False,
    yes: Annotated[bool, typer.Option("--yes", help="Move without asking, on a cell that is not simulated.")] = False,
    speed: Annotated[
        float | None,
        typer.Option(min=0.05, max=1.0, help="Share of the arms' speed, below all other limits. Default: all of it."),
    ] = None,
    enable: Annotated[
        bool, typer.Option("--enable", help="Switch the drives on first, where that ends with the program (CAN).")
    ] = False,
    emulate: Annotated[
        bool, typer.Option("--emulate", help="Start an emulator of the cell's devices beside the run; end it with it.")
    ] = False,
    fault: Annotated[
        list[str] | None,
        typer.Option("--fault", metavar="NAME@WHEN", help="A fault of that emulator, see dualcal emulate --help."),
    ] = None,
    log: Annotated[
        bool, typer.Option("--log/--no-log", help="Record all that passes between program and devices.")
    ] = True,
    json: Json = False,
) -> None:
    """Calibrate a cell: look, plan, align and capture, estimate, verify.

    Exit code 0 for verdict ok, 1 for any other verdict or a device fault, 2 for a call, cell file or captures that
    cannot be used or when there is no plan, 130 when interrupted. A session that is finished is reported again.
    """
    with ended_in_order():
        from tools.cli.run import RunOptions, run_cell

        code = run_cell(
            RunOptions(
                cell=cell,
                out=out,
                seed=seed,
                method=method,
                overrides=tuple(overrides or ()),
                dry_run=dry_run,
                yes=yes,
                log=log,
                json=json,
                resume=resume,
                speed=speed,
                emulate=emulate,
                enable=enable,
                faults=tuple(fault or ()),
                procedure=None if procedure is None else procedure.value,
            )
        )
    raise typer.Exit(code)


@app.command()
def estimate(
    captures: Annotated[
        Path,
        typer.Argument(
            metavar="CAPTURES|SESSION|TRIPLES|VIEWS",
            help="captures.json, a session folder, pose triples (JSON, CSV), or images with flange poses (JSON).",
        ),
    ],
    cell: Annotated[Path | None, typer.Option(help="The cell file; a session brings its own.")] = None,
    method: Method = None,
    truth: Annotated[Path | None, typer.Option(help="JSON {transform name: 4x4, m} to compare with.")] = None,
    out: Annotated[Path | None, typer.Option(help="Where to write the result (JSON).")] = None,
    redetect: Annotated[
        bool, typer.Option("--redetect", help="Detect the target anew in the session's recorded images.")
    ] = False,
    noise: Annotated[
        Noise | None,
        typer.Option(help="Refined: the sigmas of corners and joints, as the cell file states them or found. [stated]"),
    ] = None,
    keep_all: Annotated[
        bool, typer.Option("--keep-all", help="Refined: drop no capture, however badly it fits the others.")
    ] = False,
    free: Annotated[
        list[str] | None,
        typer.Option(metavar="KNOWN", help="Refined: leave target_mount or intrinsics to the captures; repeatable."),
    ] = None,
    sigma_a: Annotated[
        str | None, typer.Option(metavar="MM,DEG", help="Triples: sigma per axis of A, the active flange in its base.")
    ] = None,
    sigma_b: Annotated[
        str | None, typer.Option(metavar="MM,DEG", help="Triples: sigma per axis of B, the target in the camera.")
    ] = None,
    sigma_c: Annotated[
        str | None, typer.Option(metavar="MM,DEG", help="Triples: sigma per axis of C, the passive flange in its base.")
    ] = None,
    sigma_flange: Annotated[
        str | None, typer.Option(metavar="MM,DEG", help="Views: sigma per axis of a flange pose, else it is found.")
    ] = None,
    sigma_pixel: Annotated[
        float | None, typer.Option(metavar="PX", help="Views: sigma per axis of a corner, else it is found.")
    ] = None,
    json: Json = False,
) -> None:
    """Estimate and verify from captures, without any device; or without a cell from pose triples or photographs.

    How exact the poses of triples of AXB = YCZ are stands in their file, or is given with --sigma-a, -b and -c.

    How exact the flange poses of photographs are is found in them, or is stated with --sigma-flange.

    With --out pictures of what is off in photographs are written beside their result.

    Exit code 0 once there is a result, 2 for a call, cell file, captures, triples or views that cannot be used.
    """
    with ended_in_order():
        from tools.cli.estimate import EstimateOptions, estimate_captures

        sigmas = {"A": sigma_a, "B": sigma_b, "C": sigma_c}
        estimate_captures(
            EstimateOptions(
                captures=captures,
                cell=cell,
                method=method,
                truth=truth,
                out=out,
                redetect=redetect,
                noise=None if noise is None else noise.value,
                keep_all=keep_all,
                free=tuple(free or ()),
                json=json,
                sigmas=sigmas,
                sigma_flange=sigma_flange,
                sigma_pixel=sigma_pixel,
            )
        )


@app.command()
def replay(
    session: Annotated[Path, typer.Argument(metavar="SESSION", help="The session's folder.", show_default=False)],
    out: Annotated[Path | None, typer.Option(help="A new folder to keep what the replay gives.")] = None,
    json: Annotated[bool, typer.Option("--json", help="Print a JSON document alone on standard output.")] = False,
) -> None:
    """Run the procedure again on what was recorded, without any device, and compare the results.

    Exit code 0 if the replay came to the same, 1 if not or if the log is damaged, 2 for a call or session that cannot
    be used, 130 when interrupted.
    """
    with ended_in_order():
        from tools.cli.replay import ReplayOptions, replay_session

        code = replay_session(ReplayOptions(session, out, json))
    raise typer.Exit(code)


@app.command()
def doctor(
    cell: Cell,
    flange: Annotated[
        bool,
        typer.Option("--flange", help="Hold the flange's poses as the pendant shows them against our kinematics."),
    ] = False,
    wiggle: Annotated[
        bool, typer.Option("--wiggle", help="Turn each joint by 1 degree and back: it proves order and sign.")
    ] = False,
    arm: Annotated[str | None, typer.Option(help="For --flange and --wiggle: one arm. Default: both.")] = None,
    rotation: Annotated[
        str | None,
        typer.Option(
            metavar="FORM",
            help="For --flange: what the pendant shows of an orientation: rotation-vector, abb (quaternion), fanuc "
            "(W P R), kuka (A B C) or motoman (Rx Ry Rz).",
        ),
    ] = None,
    poses: Annotated[
        Path | None, typer.Option(metavar="FILE", help="For --flange: JSON or CSV, in place of typing them.")
    ] = None,
    within_mm: Annotated[float, typer.Option(min=0.1, help="For --flange: usual difference between models, mm.")] = 3.0,
    within_deg: Annotated[float, typer.Option(min=0.01, help="For --flange: the same, degrees.")] = 0.5,
    enable: Annotated[bool, typer.Option("--enable", help="For --wiggle: switch the drives on before.")] = False,
    yes: Annotated[bool, typer.Option("--yes", help="For --wiggle: begin without asking.")] = False,
    overrides: Set = None,
    json: Annotated[bool, typer.Option("--json", help="Print a JSON document alone on standard output.")] = False,
) -> None:
    """Look at each device in turn and say how it is; nothing is moved and nothing is switched on, but by --wiggle.

    On a cell that is not simulated --flange and --wiggle of both arms come before its first run. Exit code 0 if all is
    good, 1 if not, 2 for a call or cell file that cannot be used, 130 when interrupted.
    """
    with ended_in_order():
        from tools.cli.doctor import DoctorOptions, diagnose

        options = DoctorOptions(
            cell,
            tuple(overrides or ()),
            flange,
            wiggle,
            arm,
            rotation,
            poses,
            (within_mm, within_deg),
            enable,
            yes,
            json,
        )
        code = diagnose(options)
    raise typer.Exit(code)


Arm = Annotated[str, typer.Option("--arm", help="The arm, by its name in the cell file.", show_default=False)]
Yes = Annotated[bool, typer.Option("--yes", help="Do it without asking.")]


@app.command()
def enable(cell: Cell, arm: Arm, yes: Yes = False, overrides: Set = None) -> None:
    """Switch an arm's drives on, and say how it is afterwards.

    Exit code 0 if it is ready and stays so, 1 if not, 2 for a call that cannot be carried out or is not confirmed.
    """
    with ended_in_order():
        from tools.cli.operate import OperateOptions, operate

        code = operate(OperateOptions("enable", cell, arm, tuple(overrides or ()), yes))
    raise typer.Exit(code)


@app.command()
def disable(cell: Cell, arm: Arm, yes: Yes = False, overrides: Set = None) -> None:
    """Switch an arm's drives off, and say how it is afterwards.

    Exit code 0 if they are off, 1 if not, 2 for a call that cannot be carried out or is not confirmed.
    """
    with ended_in_order():
        from tools.cli.operate import OperateOptions, operate

        code = operate(OperateOptions("disable", cell, arm, tuple(overrides or ()), yes))
    raise typer.Exit(code)


@app.command()
def reset(cell: Cell, arm: Arm, yes: Yes = False, overrides: Set = None) -> None:
    """Acknowledge an arm's faults, and say how it is afterwards; its drives stay off.

    Exit code 0 if no fault is left, 1 if one is, 2 for a call that cannot be carried out or is not confirmed.
    """
    with ended_in_order():
        from tools.cli.operate import OperateOptions, operate

        code = operate(OperateOptions("reset", cell, arm, tuple(overrides or ()), yes))
    raise typer.Exit(code)


@app.command("serve-camera")
def serve_camera(
    cell: Cell,
    bind: Annotated[
        str, typer.Option(metavar="ENDPOINT", help="Where to serve; port 0 for any that is free.")
    ] = "tcp://127.0.0.1:0",
    backend: Annotated[
        str | None, typer.Option(help="The entry under backends whose camera it is. Default: camera.backend.")
    ] = None,
    name: Annotated[str, typer.Option(help="What listeners know the camera by.")] = "camera",
    rate: Annotated[float, typer.Option(min=0.1, max=1000.0, help="Frames a second, at most.")] = 25.0,
    key: Annotated[Path | None, typer.Option(metavar="FILE", help="This PC's secret key (*.key_secret).")] = None,
    allow: Annotated[
        Path | None, typer.Option(metavar="FOLDER", help="The public keys (*.key) of those who may listen.")
    ] = None,
    overrides: Set = None,
) -> None:
    """Serve a camera of a cell file from the PC that it hangs on, to cells that reach it by a zmq backend.

    Beyond this machine it is served only with --key and --allow. It goes on until a signal ends it. Exit code 130
    then, 1 when the camera is lost, 2 for a call or cell file that cannot be used.
    """
    with ended_in_order():
        try:
            from tools.cli.serve_camera import ServeOptions, serve_camera
        except ImportError as error:
            from dualcal_hal.errors import UsageError

            raise UsageError(f"what serves cameras is not installed ({error}): pip install 'dualcal[zmq]'") from error

        serve_camera(ServeOptions(cell, tuple(overrides or ()), bind, backend, name, rate, key, allow))


@app.command()
def schema() -> None:
    """Print the JSON Schema of a cell file."""
    with ended_in_order():
        import json

        from dualcal_hal.cellfile import cell_schema

        typer.echo(json.dumps(cell_schema(), indent=2))


intrinsics_app = typer.Typer(help="The camera's matrix and distortion.", no_args_is_help=True)
app.add_typer(intrinsics_app, name="intrinsics")


@intrinsics_app.callback()
def _intrinsics() -> None:
    """A group, though it has one command: dualcal run --procedure intrinsics finds them."""


@intrinsics_app.command("import")
def import_(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="OpenCV's YAML or JSON, or ROS's camera_info YAML.")],
    cell: Annotated[Path, typer.Option(help="The cell file whose camera it is.")],
    out: Annotated[Path | None, typer.Option(help="Where to write the lines for the cell file.")] = None,
    overrides: Set = None,
) -> None:
    """Turn another program's camera file into the lines for a cell file.

    Exit code 0, 2 for a file that cannot be used, or is of images of another size than the cell's.
    """
    with ended_in_order():
        from tools.cli.intrinsics import import_intrinsics

        import_intrinsics(file, cell, out, tuple(overrides or ()))


@app.command()
def emulate(
    cell: Cell,
    overrides: Set = None,
    fault: Annotated[
        list[str] | None,
        typer.Option("--fault", metavar="NAME[:ARM]@WHEN[~SECONDS]", help="Have something go wrong; may be repeated."),
    ] = None,
    free_ports: Annotated[
        bool, typer.Option("--free-ports", help="Listen at ports that are free, not at those of the cell file.")
    ] = False,
    until_stdin_closes: Annotated[
        bool, typer.Option("--until-stdin-closes", help="End when standard input closes, too.")
    ] = False,
) -> None:
    """Put the simulated world of a cell behind the real wire protocols of its controllers and its camera.

    Prints where it listens, as one line of JSON, once it does; on this machine only. Ends at SIGINT and SIGTERM.

    \b
    Faults: drop and delay (a reply), split and merge (messages), corrupt (bytes of a state), half-open
    (connections), stale (feedback), estop, mode (to manual), drive-fault, lost-link; on CAN emergency,
    node-reboot, heartbeat-loss, sdo-abort, missing-pdo, too. WHEN: seconds, as 12.5; or motion:3, which is
    0.1 s into the third motion of ARM, or of any arm where none is named; or point:7, as its seventh
    trajectory point comes. SECONDS: how long it lasts, where it does.

    Exit code 0, 1 if it could not go on, 2 for a call or cell file that cannot be used.
    """
    with ended_in_order():
        from tools.cli.emulate import EmulateOptions
        from tools.cli.emulate import emulate as serve

        serve(EmulateOptions(cell, tuple(overrides or ()), tuple(fault or ()), free_ports, until_stdin_closes))


log_app = typer.Typer(help="Look at, check, repair and export the log of a session.", no_args_is_help=True)
app.add_typer(log_app, name="log")

LogOf = Annotated[
    Path, typer.Argument(metavar="SESSION", help="The session's folder, or one file of its log.", show_default=False)
]
JsonDocument = Annotated[bool, typer.Option("--json", help="Print a JSON document alone on standard output.")]


@log_app.command()
def info(session: LogOf, json: JsonDocument = False) -> None:
    """Say what a log holds: topics with their counts, rates and longest gaps.

    Exit code 0, 1 if it is damaged, 2 if there is none that can be used.
    """
    with ended_in_order():
        from tools.cli.log import show_info

        code = show_info(session, as_json=json)
    raise typer.Exit(code)


@log_app.command()
def check(session: LogOf, json: JsonDocument = False) -> None:
    """Read all of a log: checksums, times, calls with their replies, sequences, counts.

    Exit code 0 if it is good, also where a run was killed; 1 if it is damaged, 2 if there is none that can be used.
    """
    with ended_in_order():
        from tools.cli.log import show_check

        code = show_check(session, as_json=json)
    raise typer.Exit(code)


@log_app.command()
def recover(
    session: LogOf,
    out: Annotated[Path | None, typer.Option(help="Folder for the new files. Default: beside the old.")] = None,
    json: JsonDocument = False,
) -> None:
    """Save what can be read of a damaged or unfinished log in a new file, recovered-log-NNNN.mcap; list what is lost.

    The old file is not touched. Exit code 0, 1 if nothing could be saved of a file, 2 if it cannot be done.
    """
    with ended_in_order():
        from tools.cli.log import recover as recover_log

        code = recover_log(session, out, as_json=json)
    raise typer.Exit(code)


@log_app.command()
def export(
    session: LogOf,
    out: Annotated[Path | None, typer.Option(help="A new folder. Default: export/ in the session.")] = None,
    json: JsonDocument = False,
) -> None:
    """Write joint states and steps as CSV, frames as PNG.

    Exit code 0, 1 if damage ended it early, 2 if it cannot be done.
    """
    with ended_in_order():
        from tools.cli.log import export as export_log

        code = export_log(session, out, as_json=json)
    raise typer.Exit(code)
