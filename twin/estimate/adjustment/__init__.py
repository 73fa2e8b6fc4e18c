"""Least-squares adjustment of factor graphs of poses (`pose_graph`) by a sparse Cholesky solver."""
