#!/usr/bin/env bash
# Train, evaluate and ship the runs behind the figures of this folder.
#
#   results/reproduce.sh --list              every run: done, begun or missing
#   results/reproduce.sh                     whatever is left, one run after the other
#   results/reproduce.sh --jobs 2 n2-seed0   runs whose names match, two side by side
#
# A run trains in runs/NAME (log: runs/NAME.log), is played at other N, and a copy without ballast
# goes to results/runs/NAME: then it is done. After a stop the next call goes on where it was.
set -eu
cd "$(dirname "$0")/.."

paper_world="action_mode=absolute motor=torque timestep=0.004 substeps=10 cube_mass=0.02
    finger_friction=0.5 goal_yaw=0.7854 reward_distance=250 reward_reach=0 reward_curiosity=10"

# group SEEDS TEST_N ARGUMENTS TASK-ENCODER-nN[-VARIANT]...: a line "NAME TEST_N ARGUMENTS" a run.
group() {
    for name in "${@:4}"; do
        IFS=- read -r task encoder n _ <<< "$name"
        for seed in $1; do
            echo "$name-seed$seed $2 --task $task --encoder $encoder --distractors ${n#n}" \
                 "--seed $seed" $3
        done
    done
}

all_runs() {
    group "0 1 2 3 4" 0-9,14,19 ""                     push-lrn-n2                 # figure 3
    group "0 1 2"     0-9,14,19 ""                     push-{rn,attn}-n2 lift-lrn-n2
    group "0"         0-9,14,19 ""                     lift-{rn,attn}-n2
    group "0 1 2"     0-9,14,19 "--set crowd=0"        push-lrn-n2-nocrowd
    group "0 1"       0-9,14,19 "--set crowd=0"        push-{rn,attn}-n2-nocrowd lift-lrn-n2-nocrowd
    group "0"         0-9,14,19 "--set crowd=0"        lift-{rn,attn}-n2-nocrowd
    group "0 1"       0-9       ""                     push-lrn-n{0,1,3}           # figures 1, 4
    group "0"         0-9       ""                     push-{rn,attn}-n{0,1,3}
    for n in 0 1 2; do                                         # an MLP cannot change N
        group "0"     $n        "--set frames=9000000" push-mlp-n$n
    done
    for variant in objects tokens mean; do                     # figure 5; the last --encoder counts
        group "0 1"   0-9       "--encoder lrn-$variant"     push-lrn-n2-$variant
    done
    group "0 1"       0-9,14,19 "--encoder lrn-max --set crowd=0" push-lrn-n2-maxnocrowd
    for z in 10 50 100; do
        group "0 1"   0-9       "--set z_dim=$z"             push-lrn-n2-z$z
    done
    for term in overlap distance reach; do
        group "0 1"   0-9       "--set reward_$term=0"       push-lrn-n2-no$term
    done
    group "0" 0-9 "--set frames=6000000 $paper_world"        push-{lrn,rn,attn}-n2-paperworld
    group "0" 0-9 "--paper"                                  push-lrn-n2-paper     # a day each
    group "0" 0-9 "--paper --set auxiliary=30 crowd=8"       push-lrn-n2-paperreadout
}

state_of() {
    if [ -e "results/runs/$1/checkpoint.pt" ]; then
        echo "done"
    elif [ -e "runs/$1/checkpoint.pt" ]; then
        tail -n 1 "runs/$1/progress.csv" | awk -F, '{ printf "begun, %.1f M frames\n", $2 / 1e6 }'
    else
        echo "missing"
    fi
}

one_run() {
    name=$1 test_n=$2
    begin="--out runs/$name ${*:3}"
    [ ! -e "runs/$name/checkpoint.pt" ] || begin="--resume runs/$name"
    echo "$name: $begin"
    if python train.py $begin && python evaluate.py "runs/$name" --distractors "$test_n" --save \
            && python results/ship.py "runs/$name"; then
        echo "$name: done" >&3
        exit
    fi
    echo "$name: not finished, see runs/$name.log" >&3
    exit 255                                                   # xargs starts no other run then
}

mkdir -p runs
jobs=1 list= pattern=.
while [ $# -gt 0 ]; do
    case $1 in
        --one) shift; one_run "$@" 3>&1 >> "runs/$1.log" 2>&1; exit ;;
        --jobs) jobs=$2; shift 2 ;;
        --list) list=yes; shift ;;
        *) pattern=$1; shift ;;
    esac
done
all_runs | awk -v pattern="$pattern" '$1 ~ pattern' | while read -r name arguments; do
    state=$(state_of "$name")
    if [ "$list" ]; then
        printf "%-32s %-20s %s\n" "$name" "$state" "${arguments#* }"
    elif [ "$state" != "done" ]; then
        echo "$name $arguments"
    fi
done | if [ "$list" ]; then cat; else xargs -r -P "$jobs" -L 1 results/reproduce.sh --one; fi
