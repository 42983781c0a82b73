"""One YAML file, one mapping, no key twice."""

from pathlib import Path
from typing import Any

import yaml

from groundfuse.tools.errors import DataError
from groundfuse.tools.files import read_text


class _UniqueKeys(yaml.SafeLoader):
    """PyYAML lets the last of two equal keys win without a word."""


def _mapping(loader: _UniqueKeys, node: yaml.MappingNode) -> dict[Any, Any]:
    keys = [loader.construct_object(key, deep=True) for key, _ in node.value]
    for i, key in enumerate(keys):
        if key in keys[:i]:
            line = node.value[i][0].start_mark.line + 1
            raise ValueError(f"line {line}: key {key!r} stands there twice")
    return {
        key: loader.construct_object(value, deep=True)
        for key, (_, value) in zip(keys, node.value, strict=True)
    }


_UniqueKeys.add_constructor(yaml.resolver.BaseResolver.DEFAULT_MAPPING_TAG, _mapping)


def read_mapping(path: Path) -> dict[str, Any]:
    """Return the one mapping of a YAML file, with text keys.

    Raises:
        DataError: unreadable, not YAML, not one mapping, or a key that stands there twice.
    """
    text = read_text(path)
    try:
        documents = list(yaml.load_all(text, _UniqueKeys))
    except yaml.YAMLError as error:
        raise DataError(f"{path}: not YAML: {_one_line(error, text)}") from error
    except ValueError as error:
        raise DataError(f"{path}: {error}") from error
    full = [document for document in documents if document is not None]
    if len(full) != 1 or not isinstance(full[0], dict):
        found = type(full[0]).__name__ if len(full) == 1 else f"{len(full)} documents"
        raise DataError(f"{path}: must hold one mapping (key: value), got {found}")
    return {str(key): value for key, value in full[0].items()}


def _one_line(error: yaml.YAMLError, text: str) -> str:
    mark = getattr(error, "problem_mark", None)
    problem = getattr(error, "problem", None) or str(error).splitlines()[0]
    where = "" if mark is None else f"line {mark.line + 1}: "
    opencv = "opencv-matrix" in text or text.startswith("%YAML:")
    hint = " (an OpenCV FileStorage file; a ROS camera_info file is needed)" if opencv else ""
    return f"{where}{problem}{hint}"
