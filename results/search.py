"""Print the table of the search for settings from search/*.csv: success in training by frames.

    python results/search.py

"lr" and "std" are the learning rate and the deviation of actions at the start. The other cells are
means of the 25 updates (100 000 frames) up to that point, axis-aligned, sampled actions, at N = 2;
empty if the run had been stopped before.
"""
import csv
import glob
import os

HERE = os.path.dirname(os.path.abspath(__file__))
POINTS = (0.3, 1.0, 1.6, 2.0, 3.0, 5.0)                        # million frames
WINDOW = 100_000                                               # frames


def success_at(rows, frames):
    """Mean success of the WINDOW before `frames` as text; empty if the run is not so long."""
    if int(rows[-1]["frames"]) < frames:
        return ""
    values = [float(row["success_aabb"]) for row in rows
              if frames - WINDOW < int(row["frames"]) <= frames]
    return f"{sum(values) / len(values):.2f}"


def main():
    print("| run | lr | std | " + " | ".join(f"{point} M" for point in POINTS) + " |")
    print("|---" * (3 + len(POINTS)) + "|")
    frames = []
    for path in sorted(glob.glob(os.path.join(HERE, "search", "*.csv"))):
        with open(path, newline="") as file:
            rows = list(csv.DictReader(file))
        start = f"{float(rows[0]['lr']):.1e}", f"{float(rows[0]['std']):.2f}"
        cells = [success_at(rows, point * 1e6) for point in POINTS]
        print(f"| {os.path.basename(path)[:-4]} | " + " | ".join([*start, *cells]) + " |")
        frames.append(int(rows[-1]["frames"]))
    print(f"\n{len(frames)} runs, {sum(frames) / 1e6:.0f} million frames")


if __name__ == "__main__":
    main()
