"""``dualcal log``: what a session's log holds, whether it is whole, what can be saved of it, and as tables."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import typer
from rich.console import Console
from rich.table import Table

from dualcal_hal.errors import LogDamaged, LogNotWritten, UsageError
from dualcal_hal.session.log.check import Checked, check_log
from dualcal_hal.session.log.export import export_log
from dualcal_hal.session.log.info import Info, Topic, log_info
from dualcal_hal.session.log.reader import segment_paths
from dualcal_hal.session.log.recover import Recovered, recover_log
from tools.cli.terminal import Screen

GOOD, DAMAGED = 0, 1
WIDTH = 80
_FINDINGS_SHOWN = 20


def show_info(session: Path, *, as_json: bool) -> int:
    """Duration, topics, rates and gaps of each file."""
    code, documents = GOOD, []
    for path in segment_paths(session):
        try:
            info = log_info(path)
        except LogDamaged as error:
            info = Info(path, path.stat().st_size, damage=str(error))
        if info.damage is not None:
            code = DAMAGED
        documents.append(_info_document(info))
        if not as_json:
            _print_info(_console(), info)
    _print_json(documents, as_json)
    return code


def show_check(session: Path, *, as_json: bool) -> int:
    """Every finding in each file; 1 if bytes are lost or changed."""
    code, documents = GOOD, []
    for path in segment_paths(session):
        checked = check_log(path)
        if not checked.good:
            code = DAMAGED
        documents.append(
            {
                "file": str(path),
                "good": checked.good,
                "finished": checked.ending is not None and checked.ending.finished,
                "messages": checked.messages,
                "findings": [asdict(finding) for finding in checked.findings],
            }
        )
        if not as_json:
            _print_check(_console(), checked)
    _print_json(documents, as_json)
    return code


def recover(session: Path, out: Path | None, *, as_json: bool) -> int:
    """A new file beside each one that is damaged or was never finished; ``out`` takes all of them."""
    code, documents = GOOD, []
    for path in segment_paths(session):
        checked = check_log(path)
        whole = checked.good and checked.ending is not None and checked.ending.finished
        if whole:
            documents.append({"file": str(path), "recovered": None, "messages": checked.messages})
            if not as_json:
                _say(f"{path}: is whole; nothing to recover")
            continue
        try:
            with _refused_if_not_writable():
                recovered = recover_log(path, _recovered_path(path, out))
        except LogDamaged as error:
            code = DAMAGED
            documents.append({"file": str(path), "recovered": None, "error": str(error)})
            if not as_json:
                _say(str(error))
            continue
        documents.append(_recovered_document(path, recovered))
        if not as_json:
            _print_recovered(_console(), path, recovered)
    _print_json(documents, as_json)
    return code


def export(session: Path, out: Path | None, *, as_json: bool) -> int:
    """Tables and frames; 1 if damage ended it early."""
    with _refused_if_not_writable():
        exported = export_log(session, out or (session if session.is_dir() else session.parent) / "export")
    if as_json:
        document = asdict(exported) | {"folder": str(exported.folder)}
        _print_json(document, as_json)
    else:
        table = _table("Exported", "rows")
        for arm, rows in exported.joint_states.items():
            table.add_row(f"joint states of {arm}", str(rows))
        table.add_row("steps", str(exported.steps))
        table.add_row("frames", str(exported.frames))
        _console().print(table)
        _say(f"in {exported.folder}")
        if exported.damage is not None:
            _say(f"damaged: {exported.damage}")
    return GOOD if exported.damage is None else DAMAGED


@contextmanager
def _refused_if_not_writable() -> Iterator[None]:
    """Where no device waits for a log, one that cannot be written is a wrong call."""
    try:
        yield
    except LogNotWritten as error:
        raise UsageError(str(error)) from error


def _recovered_path(path: Path, out: Path | None) -> Path:
    """Never a name that a session's log has, or two files would tell of one attempt."""
    return (out or path.parent) / f"recovered-{path.name}"


# Documents


def _info_document(info: Info) -> dict[str, Any]:
    return {
        "file": str(info.path),
        "bytes": info.size,
        "about": dict(info.about),
        "finished": info.finished,
        "end": info.end,
        "damage": info.damage,
        "duration_s": info.duration,
        "attachments": info.attachments,
        "topics": [
            {
                "topic": topic.name,
                "messages": topic.count,
                "rate_hz": topic.rate,
                "longest_gap_s": topic.gap / 1e9,
                "gap_after_s": _after(info, topic),
            }
            for topic in info.topics
        ],
    }


def _recovered_document(path: Path, recovered: Recovered) -> dict[str, Any]:
    return {
        "file": str(path),
        "recovered": str(recovered.path),
        "messages": recovered.messages,
        "losses": [asdict(loss) for loss in recovered.losses],
        "missing": recovered.missing,
    }


def _print_json(document: object, as_json: bool) -> None:
    if as_json:
        typer.echo(json.dumps(document, indent=1, allow_nan=False))


# Tables


def _console() -> Console:
    return Screen(width=WIDTH)


def _say(text: str) -> None:
    """A sentence, unbroken: a path in it is to be copied."""
    _console().print(text, soft_wrap=True, highlight=False)


def _table(*columns: str) -> Table:
    table = Table(box=None, pad_edge=False)
    table.add_column(columns[0], overflow="fold")
    for column in columns[1:]:
        table.add_column(column, justify="right")
    return table


def _print_info(console: Console, info: Info) -> None:
    _say(f"{info.path}: {info.size / 1e6:.1f} MB, {info.duration:.1f} s{_began(info)}")
    table = _table("topic", "messages", "Hz", "longest gap, s", "after, s")
    for topic in info.topics:
        rate = "" if topic.rate is None else f"{topic.rate:.1f}"
        gap = ("", "") if topic.count < 2 else (f"{topic.gap / 1e9:.2f}", f"{_after(info, topic):.1f}")
        table.add_row(topic.name, str(topic.count), rate, *gap)
    console.print(table)
    if info.attachments:
        _say(f"attached: {', '.join(info.attachments)}")
    if info.damage is not None:
        _say(f"damaged: {info.damage}")
    elif not info.finished:
        _say(f"never finished: it ends at byte {info.end}")


def _began(info: Info) -> str:
    if info.first is None:
        return ""
    return f", from {datetime.fromtimestamp(info.first // 10**9, UTC):%Y-%m-%d %H:%M:%S} UTC"


def _after(info: Info, topic: Topic) -> float:
    """When the longest gap began, s from the first message of the file."""
    return (topic.gap_from - info.first) / 1e9 if info.first is not None and topic.gap else 0.0


def _print_check(console: Console, checked: Checked) -> None:
    verdict = "good" if checked.good else "damaged"
    _say(f"{checked.path}: {verdict}, {sum(checked.messages.values())} messages")
    _print_list(
        console,
        [
            ("damage" if f.damage else "note", "" if f.offset is None else str(f.offset), f.what)
            for f in checked.findings
        ],
        ("", "byte", "found"),
    )


def _print_recovered(console: Console, path: Path, recovered: Recovered) -> None:
    _say(f"{path}: {sum(recovered.messages.values())} messages saved in {recovered.path}")
    losses = [(str(loss.offset), str(loss.length), loss.why) for loss in recovered.losses]
    _print_list(console, losses, ("at byte", "bytes", "lost"))
    for topic, count in recovered.missing.items():
        if count:
            _say(f"missing on {topic}: {count}")


def _print_list(console: Console, rows: Sequence[tuple[str, str, str]], columns: tuple[str, str, str]) -> None:
    if not rows:
        return
    table = Table(*columns, box=None, pad_edge=False)
    for row in rows[:_FINDINGS_SHOWN]:
        table.add_row(*row)
    console.print(table)
    if len(rows) > _FINDINGS_SHOWN:
        console.print(f"and {len(rows) - _FINDINGS_SHOWN} more; --json lists all")
