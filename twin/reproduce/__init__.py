"""The paper's experiments again (Negahdaripour & Madjidi 2003)."""
