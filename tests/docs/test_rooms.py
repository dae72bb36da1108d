"""`tools/rooms.py` counts floors and arrows of rooms from imports."""

from __future__ import annotations

import rooms as tool

TEXTS = {
    "dataflow/room/ground.py": "import json\n",
    "dataflow/room/first/a.py": "def f():\n    from dataflow.room.ground import json\n",
    "dataflow/room/first/b.py": "from dataflow.room import ground\n",
    "dataflow/room/roof.py": "import dataflow.room.first.a\nimport dataflow.room.ground\n",
    "dataflow/other.py": "from dataflow.room import roof\n",
}


def test_a_folder_is_one_part_and_its_arrows_count_once() -> None:
    assert tool.plan("dataflow.room", tool.arrows(TEXTS)) == (3, 3, 3, 0)
    assert tool.plan("dataflow", tool.arrows(TEXTS)) == (2, 2, 1, 0)


def test_parts_that_import_each_other_are_on_no_floor() -> None:
    texts = TEXTS | {"dataflow/room/ground.py": "from dataflow.room.first import b\n"}
    assert tool.plan("dataflow.room", tool.arrows(texts)) == (3, 0, 4, 3)


def test_this_tree_is_counted() -> None:
    lines = list(tool.report(tool.sources(None)))
    assert any(line.startswith("operators.odometry ") for line in lines)
