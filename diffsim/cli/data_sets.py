"""``diffsim data``: published recordings, where from, under which licence, and whether whole."""

from __future__ import annotations

import argparse
from pathlib import Path

HELP = "published recordings: where from, licence, sums"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Arguments of ``diffsim data``."""
    parser.add_argument("step", choices=["list", "get"], help="list: all sets; get: one of them")
    parser.add_argument("name", nargs="?", help="a data set, such as emps")
    parser.add_argument(
        "--from",
        dest="address",
        metavar="ADDRESS",
        help="folder or http address that holds the data sets, each in a folder of its name",
    )
    parser.add_argument(
        "--to", type=Path, help="folder of data sets (default: DIFFSIM_DATA or data)"
    )


def command(args: argparse.Namespace) -> None:
    """List the sets, or verify one and fetch what is missing of it.

    Raises:
        ValueError: no such data set.
        DataSetError: it is not here and cannot be had from the address.
    """
    from diffsim.core.paths import data_candidates
    from diffsim.data.published_sets import (
        DataSetError,
        differing,
        get_set,
        published_set,
        published_sets,
    )

    if args.step == "list":
        for known in published_sets().values():
            print(f"{known.name:<20} {len(known.files):>3} files  {known.licence}")
        return
    if args.name is None:
        raise ValueError("name: say which data set; `diffsim data list` has all")
    known = published_set(args.name)
    print(known.words)
    bases = [args.to] if args.to is not None else data_candidates()
    here = next((b / known.name for b in bases if (b / known.name).is_dir()), bases[0] / known.name)
    missing = differing(known, here)
    if missing and args.address is not None:
        fetched = get_set(known, here, args.address)
        print(f"fetched {len(fetched)} files from {args.address}")
    elif missing:
        is_here = len(missing) < len(known.files)
        what = f"{here / missing[0]} is missing or another file" if is_here else "not here yet"
        raise DataSetError(
            f"{known.name}: {what}; the tables were converted from the files at the address above, "
            f"and are handed on as a folder: `diffsim data get {known.name} --from ADDRESS` copies "
            "and verifies them from a folder or an http address that holds it"
        )
    print(f"{here}: {len(known.files)} files, all as described (SHA-256)")

    if known.made:
        print(f"further tables: python {here / 'make_csv.py'}; {here / 'README.md'} says how")
