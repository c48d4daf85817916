"""Watch, grade or export a policy: python play.py --task go1_flat"""

from legged_mw.programs import play

if __name__ == "__main__":
    play()
