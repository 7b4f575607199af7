"""Cache of the matches and two-view geometries of pairs of photographs.

Imports pycolmap and must not be imported in a process that uses torch (see ``isolate``).
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path

import pycolmap

_PAIR_TABLES = ("matches", "two_view_geometries")


class PairCache:
    """Cache of matches and two-view geometries: a COLMAP database whose ``pair_id`` is the cache
    key of the pair."""

    def __init__(self, folder: Path):
        # The database schema may change with COLMAP's version.
        self._name = f"pairs-{pycolmap.__version__}.db"
        path = folder / self._name
        for file in folder.glob("pairs-*.db"):
            if file != path:
                file.unlink()
        try:
            self._open(path)
        except sqlite3.DatabaseError:
            # Corrupt: the results can be computed again.
            self._connection.close()
            path.unlink()
            self._open(path)

    def _open(self, path: Path) -> None:
        self._connection = sqlite3.connect(path)
        if not self._connection.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]:
            pycolmap.Database.open(path).close()
        _check_schema(self._connection)
        self._columns = {
            table: [
                row[1]
                for row in self._connection.execute(f"PRAGMA table_info({table})")
                if row[1] != "pair_id"
            ]
            for table in _PAIR_TABLES
        }
        rows = self._connection.execute("SELECT pair_id FROM two_view_geometries")
        self._keys = {key for (key,) in rows}

    def has(self, key: int) -> bool:
        return key in self._keys

    def add(self, path: Path, keys: Mapping[tuple[int, int], int]) -> None:
        """Add the pairs of the database at ``path`` (image ids -> key)."""
        self._copy(path, _by_pair_id(keys), "other", "main")
        self._keys |= set(keys.values())

    def add_known(self, folder: Path, keys: Iterable[int]) -> None:
        """Add the pairs with these keys that the cache in another folder has, if there is one."""
        path = folder / self._name
        if not path.is_file():
            return
        with suppress(sqlite3.DatabaseError):  # Corrupt, as above.
            self._copy(path, [(key, key) for key in keys], "other", "main")
        rows = self._connection.execute("SELECT pair_id FROM two_view_geometries")
        self._keys = {key for (key,) in rows}

    def copy_to(self, path: Path, keys: Mapping[tuple[int, int], int]) -> None:
        """Copy pairs (image ids -> key) to the database at ``path``, in order of pair ids."""
        self._copy(path, [(key, pair_id) for pair_id, key in _by_pair_id(keys)], "main", "other")

    def prune(self, used: set[int]) -> None:
        """Remove the unused results if there are more of them than used ones."""
        unused = self._keys - used
        if len(unused) > len(used):
            for table in _PAIR_TABLES:
                self._connection.executemany(
                    f"DELETE FROM {table} WHERE pair_id = ?", [(key,) for key in unused]
                )
            self._connection.commit()
            self._connection.execute("VACUUM")

    def close(self) -> None:
        self._connection.close()

    def _copy(self, path: Path, ids: list[tuple[int, int]], source: str, target: str) -> None:
        """Copy rows, ``ids`` being (id in the source, id in the target), in order of target ids."""
        run = self._connection.execute
        run("ATTACH DATABASE ? AS other", (str(path),))
        try:
            # Identical photographs have equal keys: neither column is unique.
            run("CREATE TEMP TABLE renamed (old INTEGER, new INTEGER)")
            self._connection.executemany("INSERT INTO renamed VALUES (?, ?)", ids)
            for table in _PAIR_TABLES:
                columns = ", ".join(self._columns[table])
                run(
                    f"INSERT OR REPLACE INTO {target}.{table} (pair_id, {columns}) "
                    f"SELECT new, {columns} FROM renamed JOIN {source}.{table} ON pair_id = old "
                    "ORDER BY new"
                )
            self._connection.commit()
        finally:
            self._connection.rollback()
            run("DROP TABLE IF EXISTS renamed")
            run("DETACH DATABASE other")


def _check_schema(connection: sqlite3.Connection) -> None:
    """Raise a ``sqlite3.DatabaseError`` unless the database has the tables of pairs, with matrices
    of their sizes, and neither views nor triggers."""
    connection.execute("PRAGMA trusted_schema = OFF")
    kinds = dict(connection.execute("SELECT name, type FROM sqlite_master").fetchall())
    if any(kinds.get(table) != "table" for table in _PAIR_TABLES):
        raise sqlite3.DatabaseError("expected the tables of pairs")
    if {"view", "trigger"} & set(kinds.values()):
        raise sqlite3.DatabaseError("expected tables, found views or triggers")
    for table in _PAIR_TABLES:
        wrong = connection.execute(
            f"SELECT count(*) FROM {table} WHERE rows * cols * 4 != coalesce(length(data), 0)"
        ).fetchone()[0]
        if wrong:
            raise sqlite3.DatabaseError(f"expected whole matrices, found {wrong} others")


def _by_pair_id(keys: Mapping[tuple[int, int], int]) -> list[tuple[int, int]]:
    return sorted((pycolmap.image_pair_to_pair_id(*pair), key) for pair, key in keys.items())
