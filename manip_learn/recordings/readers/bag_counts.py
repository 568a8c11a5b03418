"""How many messages of each topic a bag says it has, from every place that says so."""

from __future__ import annotations

import os
import sqlite3
from collections import Counter
from pathlib import Path
from typing import Any
from urllib.parse import quote

from rosbags.rosbag1.reader import Header, RecordType, read_uint32
from ruamel.yaml import YAML

from manip_learn.errors import RecordingError

SIDE_FILES = ("-wal", "-journal")


def ros1_counts(path: Path, topics: dict[int, str]) -> Counter[str]:
    """Messages per topic of a ROS 1 bag, by its chunk information, which must agree with the index of every chunk.

    Args:
        path: The bag.
        topics: Connection -> topic.

    Raises:
        RecordingError: Chunks, connections or messages that one part of the file states and another one has not.
    """
    seen: Counter[int] = Counter()
    indexed: Counter[int] = Counter()
    stated: Counter[int] = Counter()
    size = path.stat().st_size
    with path.open("rb") as file:
        file.readline()
        first = Header.read(file, RecordType.BAGHEADER)
        file.seek(read_uint32(file), os.SEEK_CUR)
        while (at := file.tell()) < size:
            header = Header.read(file)
            kind, length = header.get_uint8("op"), read_uint32(file)
            start = file.tell()
            if start + length > size:
                raise _damaged(path, f"the record at byte {at} ends after the file")
            seen[kind] += 1
            if kind == RecordType.IDXDATA:
                indexed[header.get_uint32("conn")] += header.get_uint32("count")
            elif kind == RecordType.CHUNK_INFO:
                for _ in range(header.get_uint32("count")):
                    connection, count = read_uint32(file), read_uint32(file)
                    stated[connection] += count
            file.seek(start + length)
    for what, kind, n in (
        ("chunks", RecordType.CHUNK, first.get_uint32("chunk_count")),
        ("chunks in the index", RecordType.CHUNK_INFO, first.get_uint32("chunk_count")),
        ("connections", RecordType.CONNECTION, first.get_uint32("conn_count")),
    ):
        if seen[kind] != n:
            raise _damaged(path, f"it has {seen[kind]} {what}, its header states {n}")
    for connection in sorted(set(indexed) | set(stated)):
        if indexed[connection] != stated[connection]:
            name = topics.get(connection, f"connection {connection}")
            raise _damaged(
                path, f"its chunks index {indexed[connection]} messages of {name}, it states {stated[connection]}"
            )
    return _by_topic(stated, topics)


def _damaged(path: Path, text: str) -> RecordingError:
    return RecordingError(
        f"{path.name}: the bag is damaged: {text}; `rosbag reindex` keeps what is left", code="damaged", path=path
    )


def sqlite_counts(path: Path, shown: Path, *, alone: bool) -> Counter[str]:
    """Messages per topic in a rosbag2 database, once SQLite has found it sound.

    Args:
        path: The database.
        shown: What the message calls it.
        alone: True if there is no metadata.yaml: then the copy in the database itself must agree.

    Raises:
        RecordingError: Damaged, messages of topics that are missing, or more or fewer messages than stated.
    """
    database = sqlite3.connect(f"file:{quote(str(path))}?mode=ro&immutable=1", uri=True)
    try:
        (verdict,) = database.execute("PRAGMA integrity_check(1)").fetchone()
        topics = dict(database.execute("SELECT id, name FROM topics"))
        counted = Counter(
            dict(database.execute("SELECT topic_id, count(*) FROM messages NOT INDEXED GROUP BY topic_id"))
        )
        tables = {name for (name,) in database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
        row = None
        if alone and "metadata" in tables:
            row = database.execute("SELECT metadata FROM metadata ORDER BY id DESC LIMIT 1").fetchone()
    finally:
        database.close()
    if verdict != "ok":
        raise _refusal(shown, f"SQLite finds {' '.join(str(verdict).split())[:80]}")
    lost = set(counted) - set(topics)
    if lost:
        raise _refusal(shown, f"{sum(counted[i] for i in lost)} messages belong to no topic")
    by_topic = _by_topic(counted, topics)
    stated = _stated(row[0]) if row is not None else None
    if stated is not None:
        refuse_other_counts(shown, by_topic, stated, "its own metadata")
    return by_topic


def _refusal(path: Path, text: str) -> RecordingError:
    return RecordingError(
        f"{path.name}: the database is damaged: {text}; `sqlite3 {path.name} .recover` and `ros2 bag reindex` keep "
        "what is left",
        code="damaged",
        path=path,
    )


def _stated(text: str) -> dict[str, int] | None:
    """Messages per topic in the metadata of a bag of one file, which a recorder that was killed has not filled in."""
    content: Any = YAML(typ="safe").load(text)
    content = content.get("rosbag2_bagfile_information", content) if isinstance(content, dict) else {}
    if not content.get("message_count") or len(content.get("relative_file_paths", ())) != 1:
        return None
    return {t["topic_metadata"]["name"]: int(t["message_count"]) for t in content["topics_with_message_count"]}


def refuse_other_counts(path: Path, found: Counter[str], stated: dict[str, int], source: str) -> None:
    """Refuse a bag with more or fewer messages of a topic than it states.

    Raises:
        RecordingError: Code `lost-messages`.
    """
    for topic, n in stated.items():
        if found[topic] != n:
            raise RecordingError(
                f"{path.name}: {found[topic]} messages of {topic} are there, {source} states {n}: the bag is damaged "
                "or a part of it is missing; copy it again, or run `ros2 bag reindex` to use what is left",
                code="lost-messages",
                path=path,
            )


def refuse_side_files(path: Path) -> None:
    """Refuse a database with a write-ahead log or journal: its newest messages are not in the database yet.

    Raises:
        RecordingError: Code `unfinished`.
    """
    for end in SIDE_FILES:
        side = path.with_name(path.name + end)
        if side.is_file() and side.stat().st_size:
            raise RecordingError(
                f"{path.name}: in a copy of the folder, put the last messages into the database: sqlite3 {path.name} "
                "'PRAGMA wal_checkpoint(TRUNCATE); SELECT count(*) FROM messages;', then run `ros2 bag reindex` on the "
                f"folder. The recorder was killed, and they are in {side.name} only ({side.stat().st_size:,} bytes)",
                code="unfinished",
                path=path,
            )


def _by_topic(counts: Counter[int], topics: dict[int, str]) -> Counter[str]:
    found: Counter[str] = Counter()
    for i, n in counts.items():
        found[topics.get(i, f"connection {i}")] += n
    return found
