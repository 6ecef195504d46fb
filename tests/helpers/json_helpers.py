"""Places in a JSON tree, for tests that change one of them."""


def places(tree):
    """Yield every place of a JSON tree: its container, and its key or index."""
    for key in list(tree) if isinstance(tree, dict) else range(len(tree)):
        yield tree, key
        if isinstance(tree[key], dict | list):
            yield from places(tree[key])
