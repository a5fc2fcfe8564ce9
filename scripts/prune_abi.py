#!/usr/bin/env python3
"""Reduces an abidw dump of the shared library to what C sees.

Handles are opaque to C, so what Rust keeps inside of them is no part of the ABI: they become declarations, and types
that nothing refers to any more are dropped. usage: prune_abi.py < FULL > PRUNED
"""
import re
import sys
import xml.etree.ElementTree as xml

HANDLE = re.compile(r"mw_(context|image|surface|sizing|mesh|job)$")
TYPES = ("class-decl", "union-decl", "enum-decl", "typedef-decl", "pointer-type-def", "reference-type-def",
         "qualified-type-def", "array-type-def", "function-type", "type-decl", "subrange")


def main():
    root = xml.parse(sys.stdin).getroot()
    for node in root.iter():
        for name in ("filepath", "line", "column"):  # moved code is no change
            node.attrib.pop(name, None)
        if node.tag == "class-decl" and HANDLE.match(node.get("name", "")):
            for child in list(node):
                node.remove(child)
            node.attrib.pop("size-in-bits", None)
            node.set("is-declaration-only", "yes")
    types = {node.get("id"): node for node in root.iter() if node.tag in TYPES and node.get("id")}
    needed, waiting = set(), [node for node in root.iter("function-decl") if node.get("elf-symbol-id")]
    while waiting:
        for node in waiting.pop().iter():
            for name in ("type-id", "id"):
                reference = node.get(name)
                if reference in types and reference not in needed:
                    needed.add(reference)
                    waiting.append(types[reference])

    def prune(parent):
        for child in list(parent):
            prune(child)
            unused = child.tag in TYPES and child.get("id") and child.get("id") not in needed
            private = child.tag in ("function-decl", "var-decl") and parent.tag in ("namespace-decl", "abi-instr") \
                and not child.get("elf-symbol-id")
            empty = child.tag == "namespace-decl" and len(child) == 0
            if unused or private or empty:
                parent.remove(child)

    prune(root)
    xml.indent(root)
    print(xml.tostring(root, encoding="unicode"))


main()
