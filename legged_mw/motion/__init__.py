"""Reference motions: read files of other programs, check, resample and play them. Format: ``legged_mw.skills.clip``."""
