"""``diffsim convert``: what a recorded file holds, and its tables in another format."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from diffsim.core.files import csv_text, write_text_atomic

if TYPE_CHECKING:
    from diffsim.data.table import Table

HELP = "show what a recorded file holds, or write a table of it in another format"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``diffsim convert``."""
    parser.add_argument(
        "source",
        metavar="FILE[#PART]",
        help="CSV, Parquet, HDF5, MAT, NPZ, XLSX, JSON, PX4 ULog (.ulg), MCAP, rosbag (.bag, .db3) "
        "or the folder of a LeRobot dataset",
    )
    parser.add_argument(
        "out",
        nargs="?",
        type=Path,
        metavar="OUT",
        help=".csv, .parquet, .h5, .hdf5 or .mat; without it, parts and columns are shown",
    )


def command(args: argparse.Namespace) -> None:
    """Show the parts and columns of a file, or write one of its tables.

    Raises:
        FileNotFoundError: no such file.
        ImportError: the format's library is not installed.
        ValueError: the file cannot be read, or OUT cannot be written so.
    """
    from diffsim.data.formats import (
        is_container,
        lerobot,
        parts_of,
        renamed,
        split_part,
        write_columns,
    )
    from diffsim.data.table import Table

    file, part = split_part(args.source)
    if args.out is None and (tables := lerobot.tables_of(file)):
        for source in tables:
            _show(source, Table(source, "table"))
        return
    if args.out is None:
        for name in [part] if part or not is_container(file) else parts_of(file):
            source = Path(f"{file}#{name}" if name else file)
            _show(source, Table(source, "table"))
        return
    table = Table(Path(args.source), "table")
    columns = table.columns()
    if args.out.suffix.lower() == ".csv":
        rows = zip(*(values.tolist() for values in columns.values()), strict=True)
        out = write_text_atomic(args.out, csv_text(columns, rows))
    else:
        out = write_columns(args.out, columns)
    print(f"wrote {out}: {len(table)} rows, {len(columns)} columns")
    for sentence in table.left_out:
        print(f"not in it: {sentence}")
    if new := renamed(args.out, columns):
        print("renamed: " + ", ".join(f"{old} to {name}" for old, name in new.items()))


def _show(source: Path, table: Table) -> None:
    print(f"{source}: {len(table)} rows")
    for sentence in table.left_out:
        print(f"  not in it: {sentence}")
    for name, values in table.columns().items():
        if values.dtype.kind in "US":
            print(f"  {name}: text, such as {str(values[0])!r}")
        else:
            there = values[np.isfinite(values)]
            seen = f"{there.min():g} to {there.max():g}" if len(there) else "empty"
            print(f"  {name}: {seen}")
