"""Connectivity of a pose graph file.

The warnings report vertices without an edge, nodes of edges that no vertex line defines, and separate components.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

#: Maximum number of nodes that a warning lists, and of warnings on separate components; the rest is only counted.
_LISTED = 5

_Nodes = NDArray[np.int64]


def connection_warnings(path: Path, vertices: tuple[_Nodes, _Nodes], edges: tuple[_Nodes, _Nodes]) -> list[str]:
    """Returns the warnings about the connections of a graph.

    There is one warning for all vertices without an edge, one for all nodes that edges name but no vertex defines, and
    one for each connected component other than that of the first edge; if there are more than five such components, the
    last warning states only the number of the others. In a file without any vertex, missing vertices are not reported.

    Args:
        path: file of the graph.
        vertices: (n,) node numbers, and (n,) line numbers of the vertices.
        edges: (m, 2) node numbers, and (m,) line numbers of the edges.
    """
    (nodes, node_lines), (pairs, pair_lines) = vertices, edges
    warnings = []
    isolated = ~np.isin(nodes, pairs)
    if isolated.any():
        warnings.append(f"{path}:{node_lines[isolated][0]}: {_listed(nodes[isolated])} in no edge")
    undefined = ~np.isin(pairs, nodes).all(axis=1)
    if len(nodes) and undefined.any():
        missing = np.setdiff1d(pairs[undefined], nodes)
        warnings.append(f"{path}:{pair_lines[undefined][0]}: {_listed(missing)} in an edge, but without a vertex")
    return warnings + _separate_components(path, pairs, pair_lines)


def _separate_components(path: Path, pairs: _Nodes, pair_lines: _Nodes) -> list[str]:
    """Returns a warning for each connected component of the edges other than that of the first edge.

    After five warnings, one more states the number of the remaining components. `pairs` and `pair_lines` are the node
    numbers and lines of the edges, as in `connection_warnings`.
    """
    if not len(pairs):
        return []
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    numbers, ends = np.unique(pairs, return_inverse=True)
    ends = ends.reshape(-1, 2)
    joined = coo_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(len(numbers), len(numbers)))
    n_parts, part_of_node = connected_components(joined, directed=False)
    if n_parts == 1:
        return []
    part_of_edge = part_of_node[ends[:, 0]]
    main, warnings = part_of_edge[0], []
    for part in np.unique(part_of_edge):
        if part != main:
            line, n_nodes = pair_lines[part_of_edge == part][0], int((part_of_node == part).sum())
            node = numbers[part_of_node == part][0]
            problem = f"{n_nodes} nodes, the first of them {node}, have no edge to the component of node {pairs[0, 0]}"
            warnings.append(f"{path}:{line}: {problem}")
            if len(warnings) == _LISTED and n_parts - 1 > _LISTED:
                return [*warnings, f"{path}: and {n_parts - 1 - _LISTED} more separate components"]
    return warnings


def _listed(nodes: _Nodes) -> str:
    """Returns the subject and verb of a sentence: "node 3 is", or "nodes 3, 5, 6, 8, 9 and 7 more are"."""
    shown = ", ".join(map(str, nodes[:_LISTED].tolist()))
    more = f" and {len(nodes) - _LISTED} more" if len(nodes) > _LISTED else ""
    return f"node {shown} is" if len(nodes) == 1 else f"nodes {shown}{more} are"
