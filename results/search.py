"""Print the table of the search for settings from search/*.csv: success in training by frames.

    python results/search.py

"lr" and "std" are the learning rate and the deviation of actions in the file's first row, after the
first update or the first few: 0.50 at the start may show as 0.49. The other cells are means over
the rows of the 100 000 frames up to that point (about 25 updates), axis-aligned, sampled actions,
at N = 2; empty if the run had been stopped before.
"""
import glob
import os

from figures import read

HERE = os.path.dirname(os.path.abspath(__file__))
POINTS = (0.3, 1.0, 1.6, 2.0, 3.0, 5.0)                        # million frames
WINDOW = 100_000                                               # frames


def success_at(rows, frames):
    """Mean success of the WINDOW before `frames` as text; empty if the run is not so long."""
    if rows["frames"][-1] < frames:
        return ""
    in_window = (frames - WINDOW < rows["frames"]) & (rows["frames"] <= frames)
    return f"{rows['success_aabb'][in_window].mean():.2f}"


def main():
    print("| run | lr | std | " + " | ".join(f"{point} M" for point in POINTS) + " |")
    print("|---" * (3 + len(POINTS)) + "|")
    frames = []
    for path in sorted(glob.glob(os.path.join(HERE, "search", "*.csv"))):
        rows = read(*os.path.split(path))
        start = f"{rows['lr'][0]:.1e}", f"{rows['std'][0]:.2f}"
        cells = [success_at(rows, point * 1e6) for point in POINTS]
        print(f"| {os.path.basename(path)[:-4]} | " + " | ".join([*start, *cells]) + " |")
        frames.append(rows["frames"][-1])
    print(f"\n{len(frames)} runs, {sum(frames) / 1e6:.0f} million frames")


if __name__ == "__main__":
    main()
