"""Train a task: python train.py --task go1_flat, or on 8 GPUs: torchrun --nproc_per_node=8 train.py --task go1_flat"""

from legged_mw.programs import train

if __name__ == "__main__":
    train()
