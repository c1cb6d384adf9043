"""The reader: in order, in flat memory, up to where a file is cut off, and never anything but a typed error."""

from __future__ import annotations

import random
import shutil
import struct
import zlib
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.writer import CompressionType, Writer

from dualcal_hal.errors import LogDamaged, LogMissing, LogTooNew
from dualcal_hal.session import images
from dualcal_hal.session.log import LogReader, Note, Picture, SessionLog, next_segment, segment_paths
from dualcal_hal.session.log.framing import MAGIC
from dualcal_hal.session.log.layout import PROFILE, Layout
from tools.benchmarks.mutated_logs import Rewriter, is_replayed, mutate, read_all, replay, write_sample
from tools.golden import GOLDEN

REPLAYED_TO = ("LogDamaged", "LogEnded", "ReplayMismatch", "FrameMissing", "CommandRefused", "DeviceError", "NoPlan")


@pytest.fixture(scope="module")
def sample(tmp_path_factory):
    path = tmp_path_factory.mktemp("sample") / "log-0001.mcap"
    write_sample(path, points=4)
    return path.read_bytes()


@pytest.fixture
def path(tmp_path):
    return tmp_path / "log-0001.mcap"


def read(path):
    with LogReader(path) as reader:
        found = list(reader.items())
        return found, reader.ending


def test_a_log_can_be_read_again_and_again(path, sample):
    path.write_bytes(sample)
    with LogReader(path) as reader:
        first = [item for item in reader.items() if not isinstance(item, Picture)]
        assert first == [item for item in reader.items() if not isinstance(item, Picture)]
    assert len(first) > 30


def test_a_log_cut_off_anywhere_is_read_up_to_there(path, sample):
    path.write_bytes(sample)
    whole, _ = read(path)
    lengths = []
    for part in range(1, 50):
        path.write_bytes(sample[: len(sample) * part // 50])
        found, ending = read(path)
        assert not ending.finished
        assert ending.offset <= len(sample) * part // 50
        assert [_plain(item) for item in found] == [_plain(item) for item in whole[: len(found)]]
        lengths.append(len(found))
    assert lengths == sorted(lengths)
    assert lengths[-1] > 0.8 * len(whole)


@pytest.mark.parametrize("cut", range(1, 40))
def test_the_last_bytes_decide_whether_a_log_is_finished(path, sample, cut):
    path.write_bytes(sample[:-cut])
    found, ending = read(path)
    assert not ending.finished
    assert len(found) > 30


def _plain(item):
    return (item.sequence, item.data) if isinstance(item, Picture) else item


def test_a_flipped_byte_in_a_chunk_is_named_with_its_place(path, sample):
    place = sample.rindex(b'"StepFinished"' if b'"StepFinished"' in sample else b'"kind":"point"')
    data = bytearray(sample)
    data[place + 10] ^= 1
    path.write_bytes(bytes(data))
    with pytest.raises(LogDamaged, match=r"log-0001\.mcap: at byte \d+: the checksum of the chunk") as error:
        read(path)
    assert error.value.file == str(path)
    assert 0 < error.value.offset <= place


@pytest.mark.parametrize(
    ("content", "what"),
    [
        (b"", "is empty"),
        (MAGIC[:5], "ends here"),
        (b"\0" * 100, "is no log"),
        (b"PK\3\4 and so on", "is no log"),
        (MAGIC + b"\xff" * 100, "no record begins with 255"),
    ],
)
def test_what_is_no_log_is_damaged(path, content, what):
    path.write_bytes(content)
    with pytest.raises(LogDamaged, match=what):
        read(path)


@pytest.mark.parametrize("old", [PROFILE.encode(), MAGIC])
def test_a_later_version_is_told_as_such(path, sample, old):
    new = PROFILE.replace("/1", "/2").encode() if old is not MAGIC else MAGIC.replace(b"0", b"1")
    path.write_bytes(sample.replace(old, new, 1))
    with pytest.raises(LogTooNew, match=r"log-0001\.mcap: is .* of (format|version)"):
        read(path)


def test_somebody_elses_mcap_is_no_log_of_ours(path):
    _foreign(path, "ros2", CompressionType.NONE)
    with pytest.raises(LogDamaged, match="is no log of dualcal: its profile is 'ros2'"):
        read(path)


@pytest.mark.parametrize("compression", [CompressionType.ZSTD, CompressionType.LZ4])
def test_nothing_is_ever_decompressed(path, compression):
    _foreign(path, PROFILE, compression)
    with pytest.raises(LogDamaged, match="is compressed"):
        read(path)


def test_a_message_on_an_unknown_channel_is_damage(path):
    _foreign(path, PROFILE, CompressionType.NONE, channel=77)
    with pytest.raises(LogDamaged, match="channel 77"):
        read(path)


def test_a_topic_that_is_not_known_is_passed_over(path):
    _foreign(path, PROFILE, CompressionType.NONE)
    assert read(path) == ([], _finished(path))


def _finished(path):
    with LogReader(path) as reader:
        list(reader.items())
        return reader.ending


def _foreign(path, profile, compression, channel=None):
    with path.open("wb") as file:
        writer = Writer(file, compression=compression)
        writer.start(profile)
        number = writer.register_channel("/theirs", "json", writer.register_schema("x", "jsonschema", b"{}"))
        writer.add_message(channel or number, 0, b"{}" * 1000, 0)
        writer.finish()


@pytest.mark.parametrize("place", range(9, 17))
@pytest.mark.parametrize("value", [0xFF, 0x7F, 0x01])
def test_a_length_that_lies_allocates_nothing(path, sample, place, value, monkeypatch):
    largest = 0
    real = LogReader.__init__.__globals__["RawFile"].read

    def watched(self, offset, length):
        nonlocal largest
        data = real(self, offset, length)
        largest = max(largest, length)
        return data

    monkeypatch.setattr(LogReader.__init__.__globals__["RawFile"], "read", watched)
    data = bytearray(sample)
    data[place] = value
    path.write_bytes(bytes(data))
    with suppress(LogDamaged, LogTooNew):
        read(path)
    assert largest <= len(sample)


@pytest.mark.parametrize(
    ("missing", "what"), [("folder", "does not exist"), ("empty", "has no log"), ("other", "has no log")]
)
def test_a_folder_without_a_log_is_told(tmp_path, missing, what):
    if missing != "folder":
        (tmp_path / "folder").mkdir()
    if missing == "other":
        (tmp_path / "folder" / "log-1.mcap.bak").touch()
        (tmp_path / "folder" / "recovered-log-0001.mcap").touch()
    with pytest.raises(LogMissing, match=what):
        SessionLog(tmp_path / "folder")


def test_a_file_that_cannot_be_read_is_missing(tmp_path):
    with pytest.raises(LogMissing, match="cannot be read"):
        LogReader(tmp_path / "nothing.mcap")


def test_attempts_come_in_the_order_of_their_numbers(tmp_path):
    for number in (10, 2, 1):
        write_sample(tmp_path / f"log-{number:04d}.mcap", points=number)
    assert [path.name for path in segment_paths(tmp_path)] == ["log-0001.mcap", "log-0002.mcap", "log-0010.mcap"]
    assert next_segment(tmp_path).name == "log-0011.mcap"
    pictures = [segment for segment, item in SessionLog(tmp_path).items() if isinstance(item, Picture)]
    assert pictures == [0] + 2 * [1] + 10 * [2]


def test_the_first_attempt_is_number_one(tmp_path):
    assert next_segment(tmp_path).name == "log-0001.mcap"


def test_a_long_log_takes_no_more_memory_than_a_short_one(tmp_path):
    import tracemalloc

    peaks = []
    for points in (20, 200):
        path = tmp_path / f"log-{points:04d}.mcap"
        write_sample(path, points, (200, 150))
        tracemalloc.start()
        with LogReader(path) as reader:
            for _ in reader.items():
                pass
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.3 * peaks[0] + 200_000


# Mutations: 2,000 in all


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    path = tmp_path_factory.mktemp("small") / "log-0001.mcap"
    write_sample(path, points=2)
    return path.read_bytes()


@pytest.mark.parametrize("seed", [0, 1, 2, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(3, 10))])
def test_a_log_with_random_damage_is_read_or_refused_with_a_typed_error(tmp_path, small, seed, monkeypatch):
    monkeypatch.setattr("os.fsync", lambda _: None)
    chance = random.Random(seed)
    for _ in range(120):
        (tmp_path / "log.mcap").write_bytes(mutate(small, chance))
        read_all(tmp_path / "log.mcap", tmp_path)


@pytest.mark.parametrize("seed", [0, 1, 2, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(3, 10))])
def test_a_log_with_other_records_and_right_checksums_is_read_or_refused(tmp_path, small, seed, monkeypatch):
    monkeypatch.setattr("os.fsync", lambda _: None)
    (tmp_path / "sample.mcap").write_bytes(small)
    rewriter, chance, outcomes = Rewriter(tmp_path / "sample.mcap"), random.Random(seed), set()
    for _ in range(70):
        rewriter.write(tmp_path / "log.mcap", chance)
        outcomes.add(read_all(tmp_path / "log.mcap", tmp_path))
    assert outcomes == {"read", "LogDamaged"}


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_a_session_with_other_records_is_replayed_or_refused(tmp_path, seed, monkeypatch):
    monkeypatch.setattr("os.fsync", lambda _: None)
    session = shutil.copytree(GOLDEN, tmp_path / "session")
    rewriter, chance = Rewriter(GOLDEN / "log-0001.mcap", is_replayed), random.Random(seed)
    outcomes = set()
    for _ in range(5):
        rewriter.write(session / "log-0001.mcap", chance)
        outcomes.add(replay(session))
    assert outcomes <= {"replay 0", "replay 1", *(f"replay {each}" for each in REPLAYED_TO)}


@settings(max_examples=100, deadline=None)
@given(st.data())
def test_records_of_any_content_with_right_checksums_are_read_or_refused(tmp_path_factory, data):
    """What checksums vouch for may still be anything: a hostile writer computes them too."""
    path = tmp_path_factory.mktemp("hostile") / "log-0001.mcap"
    texts = st.one_of(
        st.binary(max_size=60),
        st.sampled_from([b"{}", b"[]", b"1" * 5000, b'{"index":1e999}', b"\x0a\xff\xff\xff\xff\x0f"]),
    )
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE, enable_data_crcs=True)
        writer.start(PROFILE)
        channels = Layout(("left",), "camera").channels()
        for channel in channels:
            writer.register_channel(channel.topic, channel.encoding, 0)
        for content in data.draw(st.lists(texts, min_size=1, max_size=5)):
            channel = data.draw(st.sampled_from(channels))
            writer.add_message(channel.number, 0, content, 0)
        writer.finish()
    read_all(path, path.parent)


# Images


def png(width, height, depth=8, colour=0, body=b"", interlaced=0, others=()):
    def block(kind, content):
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    header = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, interlaced)
    blocks = [(b"IHDR", header), *others, (b"IDAT", zlib.compress(body, 9)), (b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(block(*each) for each in blocks)


@pytest.mark.parametrize(
    ("data", "what"),
    [
        (png(1 << 30, 1 << 30), "too large"),
        (png(1 << 14, 1 << 14), "too large"),
        (png(0, 10), "too large, or empty"),
        (png(10, 10, depth=16), "no grey PNG"),
        (png(10, 10, colour=2), "no grey PNG"),
        (png(10, 10, interlaced=1), "no grey PNG"),
        (png(10, 10, others=[(b"PLTE", b"\0" * 3)]), "a block b'PLTE'"),
        (png(10, 10, others=[(b"IHDR", struct.pack(">IIBBBBB", 9, 9, 8, 0, 0, 0, 0))]), "a block b'IHDR'"),
        (png(10, 10, others=[(b"IDAT", zlib.compress(bytes(110)))], body=b"x"), "goes on behind its end"),
        (png(10, 10, body=bytes(109)), "fewer rows"),
        (png(10, 10, body=bytes(111)), "more rows"),
        (png(10, 10, others=[(b"IDAT", b"no zlib")]), "cannot be unpacked"),
        (png(10, 10)[:-5], "cut off"),
        (png(10, 10)[:30] + b"\0" + png(10, 10)[31:], "checksum"),
        (b"\x89PNG\r\n\x1a\n", "cut off"),
        (b"GIF89a", "no PNG"),
    ],
)
def test_an_image_that_asks_for_too_much_is_not_decoded(data, what):
    with pytest.raises(ValueError, match=what):
        images.decode(data, "png")


def test_what_follows_the_last_row_is_not_unpacked(capfd):
    """A few bytes may stand for a thousand times as many: what there is no room for must take no time either."""
    import time

    bomb = png(16, 16, body=bytes(1 << 29))
    assert len(bomb) < 1 << 20
    begun = time.process_time()
    with pytest.raises(ValueError, match="more rows"):
        images.decode(bomb, "png")
    assert time.process_time() - begun < 0.1
    assert capfd.readouterr().err == "", "the decoder's own words are nobody's"


@pytest.mark.parametrize("size", [(1, 1), (3, 5), (20, 30), (601, 800)])
def test_an_image_comes_back_to_the_last_bit(size):
    image = np.random.default_rng(2).integers(0, 256, size, dtype=np.uint8)
    assert np.array_equal(images.decode(images.encode(image, "png"), "png"), image)
    assert images.decode(images.encode(image, "jpeg"), "jpeg").shape == size


def test_what_is_beside_an_image_in_its_file_is_passed_over(capfd):
    note = b"note\0\0" + zlib.compress(bytes(1 << 28))
    image = png(10, 10, body=bytes(110), others=[(b"zTXt", note), (b"pHYs", b"")])
    assert images.decode(image, "png").shape == (10, 10)
    assert capfd.readouterr().err == ""


def test_an_image_of_an_unknown_format_is_not_decoded():
    with pytest.raises(ValueError, match="'tiff' is not known"):
        images.decode(b"II*\0", "tiff")


def test_a_jpeg_header_that_lies_is_not_decoded():
    data = bytearray(images.encode(np.zeros((20, 30), np.uint8), "jpeg"))
    assert images.image_size(bytes(data), "jpeg") == (30, 20)
    place = data.index(b"\xff\xc0")
    data[place + 5 : place + 9] = b"\xff\xff\xff\xff"
    with pytest.raises(ValueError, match="too large"):
        images.decode(bytes(data), "jpeg")


def jpeg():
    """A small image as it is written here: everything before its frame's header, the header, and the rest."""
    data = images.encode(np.zeros((16, 16), np.uint8), "jpeg")
    place = data.index(b"\xff\xc0")
    return data[:place], data[place : place + 13], data[place + 13 :]


def sized(header, width, height):
    return header[:5] + struct.pack(">HH", height, width) + header[9:]


@pytest.mark.parametrize(
    ("change", "what"),
    [
        (lambda before, header, after: before + b"\xff" + header + after, "ffff where a segment"),
        (lambda before, header, after: before + b"\xff\x01" + header + after, "ff01 where a segment"),
        (lambda before, header, after: before + b"\xff\xd0" + header + after, "ffd0 where a segment"),
        (lambda before, header, after: before + b"\xff\xc2" + header[2:] + after, "ffc2 where a segment"),
        (lambda before, header, after: before + header + sized(header, 9000, 7000) + after, "two sizes"),
        (lambda before, header, after: before + header + after[:-2] + header + after, "more than one scan"),
        (lambda before, header, after: before + header + after[:-2], "cut off"),
        (lambda before, header, after: before + after, "no size"),
        (lambda before, header, after: before + header[:9] + b"\x03" + header[10:] + after, "no grey JPEG"),
        (lambda before, header, after: before + header[:4] + b"\x0c" + header[5:] + after, "no grey JPEG"),
        (lambda before, header, after: before + header[:3] + b"\x01" + header[4:] + after, "cut off"),
    ],
)
def test_a_jpeg_whose_size_could_be_taken_for_another_is_not_decoded(change, what):
    """Bytes that a decoder passes over hide the header that it goes by from one that does not."""
    with pytest.raises(ValueError, match=what):
        images.decode(change(*jpeg()), "jpeg")


def test_joint_states_have_an_end_before_they_are_taken_apart(path):
    """Two bytes of an empty joint stand for a hundred in memory."""
    for count, refused in ((6, False), (4_000_000, True)):
        with path.open("wb") as file:
            writer = Writer(file, compression=CompressionType.NONE, enable_data_crcs=True)
            writer.start(PROFILE)
            channels = Layout(("left",), "camera").channels()
            numbers = {each.topic: writer.register_channel(each.topic, each.encoding, 0) for each in channels}
            writer.add_message(numbers["/left/joint_states"], 0, b"\x12\x00" * count, 0)
            writer.finish()
        if refused:
            with pytest.raises(LogDamaged, match="8000000 bytes are too many for the joints of an arm"):
                read(path)
        else:
            assert len(read(path)[0][0].positions) == count


@pytest.mark.parametrize("image_format", ["png", "jpeg"])
def test_an_image_cut_off_anywhere_is_decoded_to_its_size_or_refused(image_format, capfd):
    data = images.encode(np.random.default_rng(1).integers(0, 256, (20, 30), dtype=np.uint8), image_format)
    for length in range(0, len(data), 7):
        try:
            assert images.decode(data[:length], image_format).shape == (20, 30)
            assert image_format == "jpeg"
        except ValueError:
            pass


def test_nothing_of_pickle_is_used_in_a_log():
    folder = Path(images.__file__).parent / "log"
    for module in folder.glob("*.py"):
        text = module.read_text()
        assert not any(word in text for word in ("pickle", "marshal", "eval(", "exec(")), module


def test_a_note_is_an_item(path, sample):
    path.write_bytes(sample)
    assert read(path)[0][0] == Note("info", "begun", 0.0)
