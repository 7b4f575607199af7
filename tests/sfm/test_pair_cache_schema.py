"""A database of pairs that another program changed is replaced: the pairs are computed again."""

from __future__ import annotations

import sqlite3
import subprocess
import sys
from pathlib import Path

import pytest

# pycolmap must not share a process with torch.
OPEN = "import sys; from pathlib import Path; from pipeline.sfm.pair_cache import PairCache; "
OPEN += "cache = PairCache(Path(sys.argv[1])); print(cache.has(7)); cache.close()"

CHANGES = {
    "view": "ALTER TABLE two_view_geometries RENAME TO old;"
    "CREATE VIEW two_view_geometries AS SELECT * FROM old",
    "endless view": "DROP TABLE matches; CREATE VIEW matches AS WITH RECURSIVE n(pair_id) AS "
    "(SELECT 1 UNION ALL SELECT pair_id + 1 FROM n) SELECT pair_id FROM n",
    "another view": "CREATE VIEW other AS SELECT 1",
    "trigger": "CREATE TRIGGER t AFTER INSERT ON matches BEGIN DELETE FROM matches; END",
    "no table": "DROP TABLE matches",
    "matrix": "INSERT INTO two_view_geometries (pair_id, rows, cols, data, config) "
    "VALUES (7, 1000000, 2, x'00', 2)",
}


def opened(folder: Path) -> str:
    command = [sys.executable, "-c", OPEN, str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


@pytest.mark.parametrize("change", CHANGES)
def test_a_changed_database_is_replaced(tmp_path, change):
    assert opened(tmp_path) == "False"
    (file,) = tmp_path.glob("pairs-*.db")
    with sqlite3.connect(file) as connection:
        connection.executescript(CHANGES[change])
    connection.close()
    assert opened(tmp_path) == "False"
    with sqlite3.connect(file) as connection:
        kinds = dict(connection.execute("SELECT name, type FROM sqlite_master"))
    connection.close()
    assert kinds["matches"] == kinds["two_view_geometries"] == "table"
    assert not {"view", "trigger"} & set(kinds.values())
