"""Whether a log is whole and says nothing that contradicts itself."""

from __future__ import annotations

import struct
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from dualcal_hal.errors import LogDamaged
from dualcal_hal.session.log.framing import (
    Channel,
    CutOff,
    Damage,
    DataEnd,
    Footer,
    Malformed,
    Message,
    Opcode,
    Piece,
    Statistics,
    chunk_records,
    parse,
    parse_attachment,
    records_in,
)
from dualcal_hal.session.log.layout import arm_of, camera_of
from dualcal_hal.session.log.reader import Ending, Item, LogReader, Picture
from dualcal_hal.session.log.records import Call, FrameRef, MotionEnded, Reply, StepBegun, StepFinished, Worked

_FOOTER_HEAD = struct.Struct("<BQQQ")
_SEQUENCES = 1 << 32


@dataclass(frozen=True)
class Finding:
    """Something that is not as it should be; ``damage`` if bytes are lost or changed, else it may have an innocent
    cause such as a run that was killed.
    """

    what: str
    damage: bool
    offset: int | None = None


@dataclass(frozen=True)
class Checked:
    """One file: how many messages it has by topic, where it ends, and what was found."""

    path: Path
    messages: dict[str, int]
    ending: Ending | None
    findings: tuple[Finding, ...]

    @property
    def good(self) -> bool:
        return not any(finding.damage for finding in self.findings)


def check_log(path: Path) -> Checked:
    """Everything about one file. LogMissing or LogTooNew where there is nothing to check; damage is a finding."""
    return _Check(path).run()


class _Check:
    def __init__(self, path: Path) -> None:
        self._path = path
        self._findings: list[Finding] = []
        self._counts: Counter[str] = Counter()
        self._pairs = _Pairs()
        self._sequences: dict[str, int] = {}
        self._newest = 0
        self._topics: dict[int, str] = {}

    def run(self) -> Checked:
        ending = None
        try:
            with LogReader(self._path) as reader:
                # Numbers of channels follow from the devices: a lost list of them makes no message unreadable.
                self._topics = {channel.number: channel.topic for channel in reader.layout().channels()}
                ending = self._walk(reader)
                if ending.finished:
                    self._checksums(reader)
        except LogDamaged as error:
            self._damage(error.why, error.offset)
        finished = ending is not None and ending.finished
        if ending is not None and not finished:
            self._findings.append(Finding("the file was never finished: it ends here", False, ending.offset))
        self._findings += self._pairs.findings(finished=finished)
        return Checked(self._path, dict(self._counts), ending, tuple(self._findings))

    def _walk(self, reader: LogReader) -> Ending:
        """All records, those behind damage too; where the file ends."""
        for piece in reader.raw.pieces():
            match piece:
                case Damage(offset, _, why):
                    self._damage(why, offset)
                case CutOff(offset):
                    return Ending(offset, finished=False)
                case Piece():
                    try:
                        self._piece(reader, piece)
                    except Malformed as error:
                        self._damage(error.why, error.offset)
        return Ending(reader.raw.size, finished=True)

    def _piece(self, reader: LogReader, piece: Piece) -> None:
        if piece.opcode == Opcode.ATTACHMENT:
            parse_attachment(reader.raw.content(piece), piece.offset)
        if piece.opcode == Opcode.CHUNK:
            records = chunk_records(reader.raw.content(piece), piece.offset)
            for record in records_in(records, piece.end - len(records)):
                if isinstance(record, Channel):
                    self._topics[record.id] = record.topic
                else:
                    self._message(reader, record)

    def _damage(self, what: str, offset: int | None) -> None:
        self._findings.append(Finding(what, True, offset))

    def _message(self, reader: LogReader, message: Message) -> None:
        topic = self._topics.get(message.channel)
        if topic is None:
            self._damage(f"a message is on channel {message.channel}, which is not known", message.offset)
            return
        self._counts[topic] += 1
        if message.log_time < self._newest:
            self._damage(f"{topic}: time goes back", message.offset)
        self._newest = max(self._newest, message.log_time)
        self._sequence(topic, message)
        try:
            item = reader.item(topic, message)
        except LogDamaged as error:
            self._damage(error.why, error.offset)
            return
        if item is not None:
            for what in self._pairs.add(item):
                self._damage(what, message.offset)

    def _sequence(self, topic: str, message: Message) -> None:
        before = self._sequences.get(topic)
        self._sequences[topic] = message.sequence
        if arm_of(topic) is not None or camera_of(topic) is not None:
            # A device's own numbers: some may never have been asked for.
            if before is not None and (message.sequence - before) % _SEQUENCES >= _SEQUENCES // 2:
                self._damage(f"{topic}: sequence {message.sequence} follows {before}", message.offset)
            return
        expected = 0 if before is None else (before + 1) % _SEQUENCES
        if message.sequence != expected:
            self._damage(f"{topic}: sequence {message.sequence} where {expected} is due", message.offset)

    def _checksums(self, reader: LogReader) -> None:
        data_end, footer, statistics = _tail(reader)
        raw = reader.raw
        try:
            if data_end is None or footer is None:
                self._damage("there is no end of the data", None)
                return
            end = parse(DataEnd, raw.content(data_end), data_end.offset)
            if end.data_section_crc != raw.checksum(0, data_end.offset):
                self._damage("the checksum of the file does not fit", data_end.offset)
            foot = parse(Footer, raw.content(footer), footer.offset)
            head = _FOOTER_HEAD.pack(Opcode.FOOTER, footer.length, foot.summary_start, foot.summary_offset_start)
            begin = footer.offset if foot.summary_start == 0 else foot.summary_start
            if begin != data_end.end or raw.checksum(begin, footer.offset + len(head)) != foot.summary_crc:
                self._damage("the checksum of the summary does not fit", footer.offset)
            if statistics is not None:
                self._count(parse(Statistics, raw.content(statistics), statistics.offset), statistics.offset)
        except Malformed as error:
            self._damage(error.why, error.offset)

    def _count(self, statistics: Statistics, offset: int) -> None:
        found = sum(self._counts.values())
        if statistics.message_count != found:
            self._damage(f"{found} messages where the summary counts {statistics.message_count}", offset)


def _tail(reader: LogReader) -> tuple[Piece | None, Piece | None, Piece | None]:
    last = {piece.opcode: piece for piece in reader.raw.pieces() if isinstance(piece, Piece)}
    return last.get(Opcode.DATA_END), last.get(Opcode.FOOTER), last.get(Opcode.STATISTICS)


class _Pairs:
    """What belongs together: call and reply, motion and end, reply and frame, step and end."""

    def __init__(self) -> None:
        self._open: dict[str, dict[int, Call]] = {}
        self._next: dict[str, int] = {}
        self._moving: dict[tuple[str, int], Call] = {}
        self._pictures: dict[str, int] = {}
        self._steps: list[StepBegun] = []
        self._worked = 0

    def add(self, item: Item) -> list[str]:
        """What contradicts what came before."""
        match item:
            case Call():
                return self._call(item)
            case Reply():
                return self._reply(item)
            case MotionEnded(device, index):
                begun = self._moving.pop((device, index), None)
                return [] if begun else [f"{device}: a motion {index} ends that was not begun"]
            case Picture(camera, sequence):
                self._pictures[camera] = sequence
            case StepBegun():
                self._steps.append(item)
            case StepFinished(key):
                return self._finish(key)
            case Worked(index):
                expected, self._worked = self._worked, index + 1
                return [] if index == expected else [f"work {index} where {expected} is due"]
        return []

    def findings(self, *, finished: bool) -> list[Finding]:
        """What was still open at the end: damage in a finished file, else what a killed run leaves."""
        calls = [call for calls in self._open.values() for call in calls.values()]
        what = [f"{call.device}: {call.method} {call.index} has no reply" for call in calls]
        found = [Finding(each, finished) for each in what]
        # A run that was aborted leaves motions and steps without an end in the best of logs.
        found += [Finding(f"{device}: motion {index} has no end", False) for device, index in self._moving]
        found += [Finding(f"step {step.key.kind} of {_place(step)} has no end", False) for step in self._steps]
        return found

    def _call(self, call: Call) -> list[str]:
        expected = self._next.get(call.device, call.index)
        self._next[call.device] = call.index + 1
        self._open.setdefault(call.device, {})[call.index] = call
        return [] if call.index == expected else [f"{call.device}: call {call.index} where {expected} is due"]

    def _reply(self, reply: Reply) -> list[str]:
        call = self._open.get(reply.device, {}).pop(reply.index, None)
        if call is None:
            return [f"{reply.device}: a reply {reply.index} to no call"]
        if call.method == "start" and reply.error is None:
            self._moving[(call.device, call.index)] = call
        frame = reply.value
        if isinstance(frame, FrameRef) and self._pictures.get(frame.camera) != frame.sequence % _SEQUENCES:
            return [f"{reply.device}: the image {frame.sequence} of reply {reply.index} is missing"]
        return []

    def _finish(self, key: object) -> list[str]:
        for place in range(len(self._steps) - 1, -1, -1):
            if self._steps[place].key == key:
                del self._steps[place]
                return []
        return ["a step ends that was not begun"]


def _place(step: StepBegun) -> str:
    position = "" if step.key.position is None else f" position {step.key.position}"
    return f"{step.key.constraint or step.key.phase}{position}"
