"""Recordings in the formats that labs have, as columns by name; each by the format's own library.

``FILE#PART`` names a table of a file that holds several: a topic of a PX4 ULog, a rosbag or an
MCAP, a group of an HDF5 file, a struct of a MAT file, a sheet of Excel's.
"""

from diffsim.data.formats.columns import Columns, flat
from diffsim.data.formats.registry import (
    SUFFIXES,
    WRITTEN,
    is_container,
    left_out_of,
    parts_of,
    read_columns,
    renamed,
    split_part,
    write_columns,
)

__all__ = [
    "SUFFIXES",
    "WRITTEN",
    "Columns",
    "flat",
    "is_container",
    "left_out_of",
    "parts_of",
    "read_columns",
    "renamed",
    "split_part",
    "write_columns",
]
