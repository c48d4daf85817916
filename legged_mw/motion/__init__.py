"""Reference motions: other programs' files in, checked, resampled, looked at. The format is in ``legged_mw.skills.clip``."""
