"""The tasks, one per file: ``--task go1_flat`` is ``configs/go1_flat.py``. Configs have only numbers and names."""
