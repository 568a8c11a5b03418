"""A motion as lines of JSON: the header first, then one object per sample; NaN is null, which JSON has."""

from __future__ import annotations

import json
import math

from manip_learn.recordings.saved_motion import SavedMotion


def jsonl_bytes(motion: SavedMotion) -> bytes:
    """The lines, UTF-8."""
    columns: dict[str, list] = {"time": motion.time.tolist(), "q": motion.q.tolist()}
    for name in ("u", "effort", "manipulability", "task_error", "following_error"):
        array = getattr(motion, name)
        if array is not None:
            columns[name] = array.tolist()
    if motion.header.kind == "rollout":
        columns["status"] = [str(word) for word in motion.status]
    lines = [motion.header.to_json()]
    for values in zip(*columns.values(), strict=True):
        sample = {name: _json_value(value) for name, value in zip(columns, values, strict=True)}
        lines.append(json.dumps(sample, allow_nan=False))
    return ("\n".join(lines) + "\n").encode()


def _json_value(value: object) -> object:
    """A number, list or word; numbers that JSON lacks become null and the words inf and -inf."""
    if isinstance(value, list):
        return [_json_value(v) for v in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None if math.isnan(value) else "inf" if value > 0 else "-inf"
    return value
