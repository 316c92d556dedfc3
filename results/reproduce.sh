#!/usr/bin/env bash
# Train and evaluate the runs behind the figures and tables of this folder.
#
#   results/reproduce.sh --list              every run and how far it is
#   results/reproduce.sh                     whatever is left, one run after the other
#   results/reproduce.sh --jobs 2 push       runs with "push" in their name, two side by side
#
# A run trains on one rank in runs/NAME (log: runs/NAME.log), is then played at all N, and a copy
# without ballast goes to results/NAME. Stop with Ctrl-C: the next call goes on where it stopped.
# A run is done when results/NAME/zeroshot.csv is there; to train a shipped one anew, remove its
# folder first.
set -eu
cd "$(dirname "$0")/.."

# Lines "NAME ARGUMENTS OF train.py".
all_runs() {
    for seed in 0 1; do                                        # figure 3, top
        for encoder in lrn rn attn; do
            echo "push-$encoder-n2-seed$seed --encoder $encoder --seed $seed"
        done
    done
    for seed in 0 1; do                                        # figure 3, bottom
        for encoder in lrn rn attn; do
            echo "lift-$encoder-n2-seed$seed --encoder $encoder --seed $seed --task lift"
        done
    done
    echo "lift-lrn-n0-seed0 --encoder lrn --seed 0 --task lift --distractors 0"
}

state_of() {
    if [ -e "results/$1/zeroshot.csv" ]; then
        echo "done"
    elif [ -e "runs/$1/checkpoint.pt" ]; then
        tail -n 1 "runs/$1/progress.csv" | awk -F, '{ printf "begun, %.1f M frames\n", $2 / 1e6 }'
    else
        echo "to do"
    fi
}

one_run() {
    name=$1
    shift
    log=runs/$name.log
    mkdir -p runs
    resume=
    if [ -e "runs/$name/checkpoint.pt" ]; then
        resume=--resume
    fi
    echo "$name: $*" | tee -a "$log"
    python train.py "$@" --ranks 1 --out "runs/$name" $resume >> "$log" 2>&1
    if ! tail -n 1 "$log" | grep -q "^finished"; then
        echo "$name: stopped before its end"
        exit 255                                               # xargs starts no other run then
    fi
    python evaluate.py "runs/$name" --distractors 0-9,14,19 --save >> "$log" 2>&1
    python results/ship.py "runs/$name"
    echo "$name: done"
}

jobs=1
list=
while [ $# -gt 0 ]; do
    case $1 in
        --one) shift; one_run "$@"; exit ;;
        --jobs) jobs=$2; shift 2 ;;
        --list) list=yes; shift ;;
        *) break ;;
    esac
done
pattern=${1:-.}
if [ "$list" ]; then
    all_runs | grep -e "$pattern" | while read -r name arguments; do
        printf "%-24s %-24s %s\n" "$name" "$(state_of "$name")" "$arguments"
    done
    exit
fi
all_runs | grep -e "^[^ ]*$pattern" | while read -r name arguments; do
    if [ "$(state_of "$name")" != "done" ]; then
        echo "$name $arguments"
    fi
done | xargs -r -P "$jobs" -L 1 results/reproduce.sh --one
