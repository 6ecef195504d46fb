"""Traversal of JSON trees, for tests that change one value."""


def places(tree):
    """Yield container and key (or index) of every value in a JSON tree."""
    for key in list(tree) if isinstance(tree, dict) else range(len(tree)):
        yield tree, key
        if isinstance(tree[key], dict | list):
            yield from places(tree[key])
