"""The simulator seam: takes numbers and names, hands out torch tensors; knows no reward, command or config."""

import warp as wp

# warp announces every kernel module that it loads; a first run would drown in it
wp.config.log_level = wp.LOG_WARNING
