"""The log of a run: everything that devices were asked and answered, for replay and for viewers.

MCAP: protobuf ``foxglove.*`` messages for what viewers understand, JSON records with a schema for the rest.
"""

from dualcal_hal.session.log.layout import Layout
from dualcal_hal.session.log.reader import (
    Attached,
    Ending,
    Item,
    JointReading,
    LogReader,
    Picture,
    SessionLog,
    next_segment,
    segment_name,
    segment_paths,
)
from dualcal_hal.session.log.records import (
    Arrived,
    Call,
    FrameRef,
    MotionEnded,
    Note,
    Record,
    RecordedError,
    Reply,
    RunEnded,
    StepBegun,
    StepFinished,
    Value,
    Worked,
)
from dualcal_hal.session.log.writer import LogWriter

__all__ = [
    "Arrived",
    "Attached",
    "Call",
    "Ending",
    "FrameRef",
    "Item",
    "JointReading",
    "Layout",
    "LogReader",
    "LogWriter",
    "MotionEnded",
    "Note",
    "Picture",
    "Record",
    "RecordedError",
    "Reply",
    "RunEnded",
    "SessionLog",
    "StepBegun",
    "StepFinished",
    "Value",
    "Worked",
    "next_segment",
    "segment_name",
    "segment_paths",
]
