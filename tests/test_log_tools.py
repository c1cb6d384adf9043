"""Check, recover, info and export of a log, and the command line about them."""

from __future__ import annotations

import csv
import errno
import json
import os
from contextlib import suppress

import cv2
import numpy as np
import pytest
from mcap.reader import make_reader
from typer.testing import CliRunner

from dualcal_hal.camera import Frame
from dualcal_hal.errors import LogDamaged, LogNotWritten, LogTooNew
from dualcal_hal.robot import Mode, MotionState, RobotState
from dualcal_hal.session.log import (
    Call,
    FrameRef,
    Layout,
    LogReader,
    LogWriter,
    MotionEnded,
    Picture,
    Reply,
    Worked,
    recover,
)
from dualcal_hal.session.log.check import check_log
from dualcal_hal.session.log.export import export_log
from dualcal_hal.session.log.framing import Opcode
from dualcal_hal.session.log.info import log_info
from dualcal_hal.session.log.recover import recover_log
from tools.benchmarks.mutated_logs import STARTED, write_sample
from tools.cli.app import app

POINTS = 6


@pytest.fixture(scope="module")
def sample(tmp_path_factory):
    path = tmp_path_factory.mktemp("sample") / "log-0001.mcap"
    write_sample(path, POINTS)
    return path.read_bytes()


@pytest.fixture
def path(tmp_path, sample):
    path = tmp_path / "log-0001.mcap"
    path.write_bytes(sample)
    return path


def chunks(path):
    with LogReader(path) as reader:
        return [piece for piece in reader.pieces() if piece.opcode == Opcode.CHUNK]


def flip(path, place):
    data = bytearray(path.read_bytes())
    data[place] ^= 0x10
    path.write_bytes(bytes(data))


def items(path):
    with LogReader(path) as reader:
        return [item.sequence if isinstance(item, Picture) else item for item in reader.items()]


# Check


def test_a_good_log_is_good(path):
    checked = check_log(path)
    assert checked.good
    assert checked.findings == ()
    assert checked.messages["/camera/image"] == POINTS
    assert checked.ending.finished


def test_every_flipped_bit_of_a_finished_log_is_found(path, sample):
    """Checksums cover the whole file but its closing magic, of which the form is known."""
    for place in range(0, len(sample), 97):
        data = bytearray(sample)
        data[place] ^= 1 << (place % 8)
        path.write_bytes(bytes(data))
        with suppress(LogTooNew):
            assert not check_log(path).good, place


def test_all_damage_is_found_and_what_is_behind_it_is_counted(path):
    places = [piece.offset for piece in chunks(path)[2:5:2]]
    for place in places:
        flip(path, place + 200)
    checked = check_log(path)
    found = [finding.offset for finding in checked.findings if "checksum of the chunk" in finding.what]
    assert found == places
    assert checked.messages["/camera/image"] == POINTS - 2
    assert "/dualcal/work: sequence 3 where 2 is due" in [finding.what for finding in checked.findings]


def test_a_log_that_was_never_finished_is_good_up_to_there(path, sample):
    path.write_bytes(sample[: chunks(path)[-1].end])
    checked = check_log(path)
    assert checked.good
    assert [finding.what for finding in checked.findings] == ["the file was never finished: it ends here"]


def write(path, *records, frames=()):
    path.unlink(missing_ok=True)
    with LogWriter(path, STARTED, arms=("left",)) as log:
        for frame in frames:
            log.frame(frame)
        for record in records:
            log.record(record)
    return [finding.what for finding in check_log(path).findings]


STATE = RobotState((0.0,), (0.0,), Mode.READY, (), 0.0, 0)


@pytest.mark.parametrize(
    ("records", "what"),
    [
        ([Call("left", 0, "read", {}, 0.0)], "left: read 0 has no reply"),
        ([Reply("left", 0, None, 0.0)], "left: a reply 0 to no call"),
        ([Worked(1, "plan", None, None, 0.0)], "work 1 where 0 is due"),
        ([MotionEnded("left", 3, MotionState.SETTLED, STATE, 0.0)], "left: a motion 3 ends that was not begun"),
        (
            [Call("camera", 0, "grab", {}, 0.0), Reply("camera", 0, FrameRef("camera", 5, 0.0), 0.0)],
            "camera: the image 5 of reply 0 is missing",
        ),
        (
            [
                Call("left", 0, "read", {}, 0.0),
                Reply("left", 0, STATE, 0.0),
                Call("left", 2, "read", {}, 0.0),
                Reply("left", 2, STATE, 0.0),
            ],
            "left: call 2 where 1 is due",
        ),
    ],
)
def test_what_contradicts_itself_is_found(path, records, what):
    assert write(path, *records) == [what]
    assert not check_log(path).good


def test_a_motion_without_an_end_is_told_but_no_damage(path):
    found = write(path, Call("left", 0, "start", {}, 0.0), Reply("left", 0, None, 0.0))
    assert found == ["left: motion 0 has no end"]
    assert check_log(path).good


# Recover


def test_a_log_cut_off_at_every_fiftieth_gives_what_was_whole(path, sample, tmp_path):
    whole = items(path)
    for part in range(1, 51):
        path.write_bytes(sample[: len(sample) * part // 50])
        target = tmp_path / f"recovered-{part}.mcap"
        recovered = recover_log(path, target)
        found = items(target)
        assert found == whole[: len(found)]
        assert len(found) >= len(items(path)), "whole messages of the last chunk are saved too"
        assert all(finding.damage is False for finding in check_log(target).findings if "check" in finding.what)
        assert not any(recovered.missing.values())
    assert found == whole


def test_a_damaged_chunk_costs_its_messages_and_is_listed(path, tmp_path):
    whole = items(path)
    broken = chunks(path)[2]
    flip(path, broken.offset + 200)
    before = path.read_bytes()
    recovered = recover_log(path, tmp_path / "new.mcap")
    (loss,) = recovered.losses
    assert (loss.offset, "checksum" in loss.why) == (broken.offset, True)
    assert loss.length <= broken.end - broken.offset
    found = items(tmp_path / "new.mcap")
    assert 0 < len(whole) - len(found) < 15
    assert [item for item in whole if item in found] == found
    assert recovered.missing == {
        "/camera/annotations": 1,
        "/camera/image": 1,
        "/dualcal/calls": 2,
        "/dualcal/motions": 1,
        "/dualcal/replies": 2,
        "/dualcal/steps/begun": 1,
        "/dualcal/steps/finished": 1,
        "/dualcal/work": 1,
        "/left/joint_states": 1,
        "/tf": 1,
    }
    assert path.read_bytes() == before


def test_what_a_chunk_had_is_told_by_the_summary_alone_too(path, tmp_path):
    """Its head and the indexes behind it are lost with it."""
    first, second = chunks(path)[2:4]
    data = path.read_bytes()
    path.write_bytes(data[: first.offset] + b"\xff" * (second.offset - first.offset) + data[second.offset :])
    recovered = recover_log(path, tmp_path / "new.mcap")
    assert (recovered.missing["/camera/image"], recovered.missing["/left/joint_states"]) == (1, 1)


def test_an_image_that_is_lost_is_told_by_the_reply_that_speaks_of_it(path, tmp_path):
    """In a file that was never finished, and of which the chunk with the image alone is lost."""
    image = Frame(np.zeros((8, 8), np.uint8), 0.5, 7)
    path.unlink()
    with LogWriter(path, STARTED, arms=("left",)) as log:
        log.record(Call("camera", 0, "grab", {}, 0.0))
        log.sync()
        log.frame(image)
        log.sync()
        log.record(Reply("camera", 0, FrameRef("camera", 7, 0.5), 0.6))
        log.sync()
    lost, behind = chunks(path)[-2:]
    data = path.read_bytes()
    path.write_bytes(data[: lost.offset] + b"\xff" * (behind.offset - lost.offset) + data[behind.offset : behind.end])
    assert recover_log(path, tmp_path / "new.mcap").missing == {"/camera/image": 1}


def test_behind_bytes_that_make_no_sense_the_way_on_is_found(path, tmp_path):
    first, second = chunks(path)[1:3]
    data = path.read_bytes()
    for junk, name in ((b"", "cut"), (b"\xff" * 1000, "longer"), (b"\x06" * 333, "alike")):
        path.write_bytes(data[: first.offset + 20] + junk + data[second.offset - 7 :])
        recovered = recover_log(path, tmp_path / f"{name}.mcap")
        assert recovered.losses
        assert recovered.messages["/camera/image"] == POINTS - 1


def test_without_its_list_of_channels_a_log_is_read_by_what_it_says_of_its_devices(path, tmp_path, sample):
    flip(path, chunks(path)[0].offset + 300)
    path.write_bytes(path.read_bytes()[: chunks_end(sample, tmp_path)])
    recovered = recover_log(path, tmp_path / "new.mcap")
    assert recovered.messages["/left/joint_states"] == POINTS - 1


def chunks_end(sample, folder):
    (folder / "whole.mcap").write_bytes(sample)
    return chunks(folder / "whole.mcap")[-1].end


def test_a_log_whose_beginning_is_damaged_is_saved_too(path, tmp_path):
    flip(path, 3)
    recovered = recover_log(path, tmp_path / "new.mcap")
    assert recovered.messages["/camera/image"] == POINTS


def test_metadata_and_attachments_are_kept(path, tmp_path):
    flip(path, chunks(path)[2].offset + 200)
    recover_log(path, tmp_path / "new.mcap")
    with LogReader(tmp_path / "new.mcap") as reader:
        assert [kept.name for kept in reader.attachments()] == ["cell.yaml", "result.json"]
        assert reader.about()["cell"] == "sample"
        assert reader.about()["recovered_from"] == "log-0001.mcap"
    with (tmp_path / "new.mcap").open("rb") as file:
        assert make_reader(file, validate_crcs=True).get_summary().statistics.message_count > 40


@pytest.mark.parametrize("arms", [[], ["left"], ["left", "right"], ["a"] * 16])
def test_devices_determine_the_channels(arms):
    layout = Layout(tuple(arms), "camera")
    assert Layout.from_text(layout.to_text()) == layout
    assert Layout.of_topics([channel.topic for channel in layout.channels()]) == layout
    assert [channel.number for channel in layout.channels()] == list(range(1, 15 + len(arms)))


@pytest.mark.parametrize("text", ["", "{", "[]", "null", '{"arms": 3, "camera": "c"}', '{"arms": [1], "camera": "c"}'])
def test_devices_that_are_none_are_refused(text):
    with pytest.raises(ValueError, match=r"\w"):
        Layout.from_text(text)


def test_more_arms_than_there_are_anywhere_are_refused():
    with pytest.raises(ValueError, match="17 arms are too many"):
        Layout.from_text(json.dumps({"arms": ["a"] * 17, "camera": "c"}))
    with pytest.raises(ValueError, match="17 arms are too many"):
        Layout.of_topics(["/a/joint_states"] * 17)


def test_nothing_is_saved_where_there_is_nothing(tmp_path):
    (tmp_path / "noise.mcap").write_bytes(os.urandom(5000))
    with pytest.raises(LogDamaged, match="nothing in it that can be saved"):
        recover_log(tmp_path / "noise.mcap", tmp_path / "new.mcap")
    assert not (tmp_path / "new.mcap").exists()


def test_no_file_is_replaced(path, tmp_path):
    (tmp_path / "new.mcap").write_bytes(b"precious")
    with pytest.raises(LogNotWritten, match=r"new\.mcap: .*File exists"):
        recover_log(path, tmp_path / "new.mcap")
    assert (tmp_path / "new.mcap").read_bytes() == b"precious"


def test_a_full_disk_leaves_no_half_file(path, tmp_path, monkeypatch):
    def full(self, *args):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(recover.FileWriter, "finish", full)
    with pytest.raises(LogNotWritten, match="No space left"):
        recover_log(path, tmp_path / "new.mcap")
    assert not (tmp_path / "new.mcap").exists()


# Info


def test_info_counts_and_finds_the_longest_gap(path):
    info = log_info(path)
    images = next(topic for topic in info.topics if topic.name == "/camera/image")
    assert images.count == POINTS
    assert images.rate == pytest.approx(0.1)
    assert images.gap == pytest.approx(10e9)
    assert info.attachments == ["cell.yaml", "result.json"]
    assert info.finished
    assert info.duration == pytest.approx(10 * (POINTS - 1) + 1 / 3 + 2.4)


def test_info_of_a_log_cut_off_says_where_it_ends(path, sample):
    path.write_bytes(sample[: len(sample) // 2])
    info = log_info(path)
    assert not info.finished
    assert 0 < info.end <= len(sample) // 2


# Export


def test_tables_name_their_units_and_hold_exact_values(path, tmp_path):
    exported = export_log(path, tmp_path / "out")
    assert (exported.frames, exported.steps, exported.joint_states) == (POINTS, POINTS, {"left": POINTS})
    with (tmp_path / "out" / "joint_states_left.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert list(rows[0])[3:] == ["position_1_rad", "position_2_rad", "velocity_1_rad_s", "velocity_2_rad_s"]
    assert float(rows[3]["position_2_rad"]) == 1 / 7
    with (tmp_path / "out" / "steps.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert rows[0]["begun_s"] == str(1 / 3)
    assert [row["position"] for row in rows] == [str(point) for point in range(POINTS)]


def test_frames_are_images_that_any_program_opens(path, tmp_path):
    export_log(path, tmp_path / "out")
    files = sorted((tmp_path / "out" / "frames").iterdir())
    assert [file.name for file in files] == [f"camera-0001-{number:08d}.png" for number in range(POINTS)]
    with LogReader(path) as reader:
        pictures = [item for item in reader.items() if isinstance(item, Picture)]
    for file, picture in zip(files, pictures, strict=True):
        assert np.array_equal(cv2.imread(str(file), cv2.IMREAD_GRAYSCALE), picture.decode())


def test_a_name_in_a_log_leads_nowhere_else(tmp_path):
    path = tmp_path / "log-0001.mcap"
    with LogWriter(path, STARTED, arms=("../../evil",)) as log:
        log.joint_states("../../evil", STATE)
    export_log(path, tmp_path / "a" / "out")
    assert [file.name for file in (tmp_path / "a" / "out").glob("*.csv")] == ["joint_states_.._.._evil.csv"]
    assert not list(tmp_path.glob("*.csv"))


# Command line


def call(*arguments):
    return CliRunner().invoke(app, ["log", *map(str, arguments)])


@pytest.mark.parametrize("command", ["info", "check", "recover", "export"])
def test_a_good_session_ends_with_0(path, command):
    done = call(command, path.parent)
    assert done.exit_code == 0, done.output
    assert all(len(line) <= 80 for line in done.stdout.splitlines() if str(path.parent) not in line)


@pytest.mark.parametrize("command", ["info", "check", "recover", "export"])
def test_a_document_alone_is_printed_on_demand(path, command):
    done = call(command, path.parent, "--json")
    assert done.exit_code == 0
    json.loads(done.stdout)


@pytest.mark.parametrize("command", ["check", "export"])
def test_damage_ends_with_1(path, command):
    flip(path, chunks(path)[2].offset + 200)
    done = call(command, path.parent)
    assert done.exit_code == 1
    assert "checksum of the chunk does not fit" in " ".join(done.output.split())


@pytest.mark.parametrize("command", ["info", "check", "recover", "export"])
def test_an_empty_file_is_damaged_in_one_sentence(tmp_path, command):
    (tmp_path / "log-0001.mcap").touch()
    done = call(command, tmp_path)
    assert done.exit_code == 1
    assert "Traceback" not in done.output
    assert "empty" in done.output or "nothing in it" in done.output


@pytest.mark.parametrize("command", ["info", "check", "recover", "export"])
def test_a_folder_without_a_log_ends_with_2(tmp_path, command):
    done = call(command, tmp_path)
    assert done.exit_code == 2
    assert "has no log" in done.stderr
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.parametrize("command", ["info", "check", "recover", "export"])
def test_a_newer_version_ends_with_2(path, sample, command):
    path.write_bytes(sample.replace(b"dualcal.log/1", b"dualcal.log/9", 1))
    done = call(command, path.parent)
    assert done.exit_code == 2
    assert "format 9" in done.stderr


@pytest.mark.parametrize("command", ["recover", "export"])
def test_a_folder_that_takes_nothing_ends_with_2(path, command):
    path.write_bytes(path.read_bytes()[:-100])
    (path.parent / "out").write_bytes(b"no folder")
    done = call(command, path.parent, "--out", path.parent / "out")
    assert done.exit_code == 2
    assert "cannot be written" in done.stderr or "not an empty folder" in done.stderr


def test_recover_writes_beside_what_it_reads_and_lists_what_is_lost(path):
    flip(path, chunks(path)[2].offset + 200)
    done = call("recover", path.parent)
    assert done.exit_code == 0
    assert (path.parent / "recovered-log-0001.mcap").exists()
    assert "missing on /dualcal/calls: 2" in done.stdout
    assert "missing on /camera/image: 1" in done.stdout
    assert call("check", path.parent / "recovered-log-0001.mcap").exit_code == 1, "what is missing stays missing"


def test_a_second_recovery_says_what_to_do(path):
    path.write_bytes(path.read_bytes()[:-100])
    assert call("recover", path.parent).exit_code == 0
    before = (path.parent / "recovered-log-0001.mcap").read_bytes()
    again = call("recover", path.parent)
    assert again.exit_code == 2
    assert "recovered-log-0001.mcap: File exists: it was recovered before? Name another" in again.stderr
    assert (path.parent / "recovered-log-0001.mcap").read_bytes() == before
    (path.parent / "other").mkdir()
    assert call("recover", path.parent, "--out", path.parent / "other").exit_code == 0


def test_what_a_log_holds_is_no_command_for_the_terminal(tmp_path):
    path = tmp_path / "log-0001.mcap"
    with LogWriter(path, STARTED, arms=("[red]\x1b[31m",)) as log:
        log.joint_states("[red]\x1b[31m", STATE)
    done = call("info", tmp_path)
    assert done.exit_code == 0
    assert "\x1b" not in done.stdout
    assert "[red]" in done.stdout
