"""Tasks, one a file: ``--task go1_flat`` is ``configs/go1_flat.py``. Numbers and names only."""
