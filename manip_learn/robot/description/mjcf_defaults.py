"""Default classes of an MJCF file: which attributes an element has when all inheritance is done."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

from manip_learn.robot.description.diagnostics import GateLog, shortened
from manip_learn.robot.description.xml_node import XmlNode

DEFAULTED = ("joint", "geom", "site", "mesh")
MAIN = "main"
Attributes = dict[str, dict[str, str]]


@final
@dataclass(frozen=True)
class MjcfDefaults:
    """Default attributes of each class, inheritance done: class -> tag -> attribute -> text."""

    classes: dict[str, Attributes]

    def of(self, node: XmlNode, childclass: str, log: GateLog) -> XmlNode:
        """The element with the attributes of its class filled in; `childclass` is that of the body around it.

        Raises:
            RobotError: Code `mjcf-class`: the class does not exist.
        """
        name = node.attributes.get("class", childclass)
        if name not in self.classes:
            seen = f"<{node.tag}> has the class {shortened(name)!r}, which no <default> defines"
            raise log.refusal(
                "mjcf-class", node.line, "the file", seen, "a defined class is wanted", "correct the name"
            )
        attributes = self.classes[name].get(node.tag, {}) | node.attributes
        return XmlNode(node.tag, attributes, node.line, node.children)


def read_defaults(root: XmlNode) -> MjcfDefaults:
    """Default classes of a file; the outermost is called `main`."""
    classes: dict[str, Attributes] = {MAIN: {}}
    for top in root.all("default"):
        pending: list[tuple[XmlNode, Attributes, str]] = [(top, classes[MAIN], top.attributes.get("class", MAIN))]
        while pending:
            node, inherited, name = pending.pop()
            own = {tag: dict(values) for tag, values in inherited.items()}
            for child in node.children:
                if child.tag in DEFAULTED:
                    own[child.tag] = own.get(child.tag, {}) | child.attributes
            classes[name] = own
            if node is top:
                classes[MAIN] = own
            pending += [(c, own, c.attributes.get("class", "")) for c in node.all("default")]
    return MjcfDefaults(classes)
