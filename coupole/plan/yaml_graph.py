"""The graph of nodes of a YAML text.

ruamel.yaml reads YAML 1.2, in Python. libyaml (through PyYAML) makes the same nodes in a quarter of the time, but
reads YAML 1.1. So libyaml composes only plain texts: printable ASCII without anchors, aliases, tags, directives,
escapes, block scalars, complex keys, several documents and empty values. For these texts both libraries make the
same nodes at the same places, once scalars are resolved by ruamel's rules; a property test checks this. ruamel
composes all other texts, and all texts that libyaml refuses. Its graph counts, or its error and the place of the
error.
"""

from __future__ import annotations

import functools
import re

import yaml
from ruamel.yaml import YAML
from ruamel.yaml.nodes import MappingNode, Node, ScalarNode, SequenceNode

_COMMENT_LINES = re.compile(r"^ *#.*$", re.MULTILINE)
_NOT_PLAIN = re.compile(r"[^\n\x20-\x7e]|[&*!@`\\|>?]|^%|^---|^\.\.\.", re.MULTILINE)
_resolver = YAML(typ="safe", pure=True).resolver


@functools.lru_cache(maxsize=4)
def graph(text: str) -> Node | None:
    """Compose a text into its nodes; None if it has no content. The nodes must not be changed, because a text is
    composed once for reading and rewriting. Raises ruamel.yaml's YAMLError, and RecursionError."""
    return _composed_quickly(text) or composed_by_ruamel(text)


def composed_by_ruamel(text: str) -> Node | None:
    """Compose any text by ruamel.yaml; None if it has no content."""
    reader = YAML(typ="safe", pure=True)
    reader.composer.warn_double_anchors = False  # YAML 1.2 (3.2.2.2): a later anchor may replace an earlier one
    root: Node | None = reader.compose(text)
    return root


def _composed_quickly(text: str) -> Node | None:
    """Compose a text by libyaml; None if libyaml is missing, refuses the text, or might understand it
    differently."""
    if not yaml.__with_libyaml__ or _NOT_PLAIN.search(_COMMENT_LINES.sub("", text)):
        return None
    ends = text.endswith("\n")
    try:
        root = yaml.compose(text if ends else text + "\n", Loader=yaml.CSafeLoader)
        # Where the text just ends, so does an open block.
        whole = ends or (isinstance(root, yaml.CollectionNode) and root.flow_style)
        return _ruamel_node(root) if root is not None and whole else None
    except (yaml.YAMLError, _EmptyError):
        return None


class _EmptyError(Exception):
    """Raised for an empty value, which the two libraries place differently."""


def _ruamel_node(node: yaml.Node) -> Node:
    """Return ruamel's node for PyYAML's, with the tag that ruamel gives it. Raises _EmptyError."""
    marks = node.start_mark, node.end_mark
    if isinstance(node, yaml.ScalarNode):
        if node.start_mark.index == node.end_mark.index:
            raise _EmptyError
        plain = not node.style
        tag = _resolver.resolve(ScalarNode, node.value, (plain, not plain))
        return ScalarNode(tag, node.value, *marks, style=node.style or None)
    kind = SequenceNode if isinstance(node, yaml.SequenceNode) else MappingNode
    inner = (
        [_ruamel_node(child) for child in node.value]
        if isinstance(node, yaml.SequenceNode)
        else [(_ruamel_node(key), _ruamel_node(value)) for key, value in node.value]
    )
    return kind(_resolver.resolve(kind, None, (True, True)), inner, *marks, flow_style=node.flow_style)
