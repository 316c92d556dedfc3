#!/usr/bin/env bash
# Train and evaluate the runs behind the figures and tables of this folder (but
# unfinished/push-lrn-n2-paper-seed1 and the untrained agents: see probe.txt and thrown.txt).
#
#   results/reproduce.sh --list              every run and how far it is
#   results/reproduce.sh                     whatever is left, one run after the other
#   results/reproduce.sh --jobs 2 push       runs with "push" in their names, two side by side
#
# A run trains on one rank in runs/NAME (log: runs/NAME.log), is then played at other N, and a copy
# without ballast goes to results/NAME. Stop with Ctrl-C: the next call goes on where it stopped.
# A run is done when results/NAME/zeroshot.csv is there; to train a shipped one anew, remove
# results/NAME and runs/NAME first. LRN's runs of figure 3 are also played recentred.
set -eu
cd "$(dirname "$0")/.."

# a_run TASK ENCODER N SEED [WORD, ARGUMENTS OF train.py]: prints "NAME ARGUMENTS OF train.py".
a_run() {
    echo "$1-$2-n$3${5:+-$5}-seed$4 --task $1 --encoder $2 --distractors $3 --seed $4 ${*:6}"
}

# The runs of all figures, those of the first seed first.
all_runs() {
    paper_reward="reward_distance=250 reward_reach=0 reward_curiosity=10"
    paper_cube="cube_mass=0.02 finger_friction=0.1"
    paper_world="action_mode=absolute $paper_cube goal_yaw=0.7854"
    paper_control="substeps=3 timestep=0.004 episode_steps=2500 steps=2500 envs=2"
    paper_ppo="lr=2.5e-4 clip=0.5 anneal_clip=True epochs=4 minibatches=40 adam_eps=1e-8 log_std=0"
    for seed in 0 1 2 3 4; do
        for encoder in lrn rn attn; do
            a_run push $encoder 2 $seed                        # figure 3, top
        done
        if [ $seed -le 2 ]; then
            for encoder in lrn rn attn; do
                a_run lift $encoder 2 $seed                    # figure 3, bottom
            done
            for task in push lift; do
                a_run $task lrn-max 2 $seed
            done
            for N in 0 1 3; do                                 # figure 4, and LRN of figure 1
                for encoder in lrn rn attn; do
                    a_run push $encoder $N $seed
                done
            done
            a_run push lrn 2 $seed norelations --set relations=False    # figure 5, left
            a_run push lrn 2 $seed mean --set layer_norm=False
            for width in 10 50 100; do
                a_run push lrn 2 $seed z$width --set z_dim=$width
            done
            a_run push lrn 2 $seed nooverlap --set reward_overlap=0     # figure 5, right
            a_run push lrn 2 $seed nodistance --set reward_distance=0
            a_run push lrn 2 $seed noreach --set reward_reach=0
            a_run push lrn 2 $seed curiosity --set reward_curiosity=10
            a_run push lrn 2 $seed sparse --set reward_distance=0 reward_reach=0 \
                reward_curiosity=10
            a_run push lrn 2 $seed paperreward --set $paper_reward
        fi
        if [ $seed -le 1 ]; then
            for N in 0 1 2; do                                 # MLP of figure 1
                a_run push mlp $N $seed
            done
            for N in 1 2; do
                a_run push mlp $N $seed long --frames 9000000
            done
            a_run push lrn-max 9 $seed                         # beyond the paper: 9 in training
            a_run push lrn 2 $seed noreadout --set auxiliary=0 # without our read-out loss
            for encoder in lrn rn attn; do                     # the paper's world
                a_run push $encoder 2 $seed paperworld-long --frames 6000000 --set $paper_world \
                    $paper_reward
            done
        fi
        if [ $seed = 0 ]; then
            for encoder in rn attn; do
                a_run push $encoder 2 $seed noreadout --set auxiliary=0
            done
            for encoder in lrn rn attn; do
                a_run push $encoder 2 $seed noreadout-long --frames 20000000 --set auxiliary=0
            done
            a_run push lrn 0 $seed noreadout --set auxiliary=0
            a_run push lrn 2 $seed noreadout-paperreward --set auxiliary=0 \
                $paper_reward
            a_run push lrn 2 $seed noreadout-paperworld --set auxiliary=0 $paper_world \
                $paper_reward
            a_run push lrn 2 $seed noreadout-paperworld-long --frames 10000000 --set auxiliary=0 \
                $paper_world $paper_reward
            a_run push lrn 2 $seed noreadout-slippery --set auxiliary=0 $paper_cube \
                $paper_reward
            a_run push lrn 2 $seed noreadout-absolute --set auxiliary=0 action_mode=absolute \
                $paper_reward
            a_run push lrn 2 $seed noreadout-curiosity --set auxiliary=0 reward_curiosity=10
            a_run push lrn 2 $seed rawvalues --set normalize_values=False
            a_run push lrn 2 $seed rawadvantages --set normalize_advantages=False
            a_run push lrn 2 $seed absolute --set action_mode=absolute
            a_run push lrn 2 $seed paperworld --set $paper_world $paper_reward
            a_run push lrn 2 $seed paperworld-ppo --set $paper_world $paper_reward $paper_ppo
            a_run push lrn 2 $seed paperworld-std --set $paper_world $paper_reward log_std=0
            a_run push lrn 2 $seed paperworld-30s --set $paper_world $paper_reward \
                $paper_control
            a_run push lrn 2 $seed paperworld-rawvalues --set $paper_world $paper_reward \
                normalize_values=False
            a_run push lrn 2 $seed paperworld-rawadvantages --set $paper_world $paper_reward \
                normalize_advantages=False
            a_run push lrn 2 $seed papercube --set $paper_cube goal_yaw=0.7854
            a_run push lrn 2 $seed paperppo --set $paper_ppo
            a_run push lrn 2 $seed papercontrol --set $paper_control
            a_run push lrn 2 $seed paper --paper                # the printed recipe, 60 M frames
            a_run push lrn 2 $seed paper-script --paper --set clip=0.2 reward_distance=2500 \
                reward_reach=2500 reward_curiosity=0           # as CausalWorld's own script
            a_run push lrn 2 $seed paper-values --paper --set normalize_values=True
            a_run push lrn 2 $seed paper-normalized --paper --set normalize_values=True \
                normalize_advantages=True
            a_run push lrn 2 $seed paper-readout --paper --set normalize_values=True \
                normalize_advantages=True auxiliary=30
            a_run push lrn 2 $seed paper-batch --paper --set normalize_values=True \
                normalize_advantages=True auxiliary=30 entropy=0.001 envs=8
            a_run push lrn 2 $seed paper-short --paper --set normalize_values=True \
                normalize_advantages=True auxiliary=30 entropy=0.001 envs=8 episode_steps=500
            a_run push lrn 2 $seed paper-25hz --paper --set normalize_values=True \
                normalize_advantages=True auxiliary=30 entropy=0.001 envs=8 episode_steps=125 \
                substeps=5 timestep=0.008
            a_run push lrn 9 $seed
            a_run lift lrn 0 $seed
        fi
    done
}

state_of() {
    if [ -e "results/$1/zeroshot.csv" ]; then
        echo "done"
    elif [ -e "runs/$1/checkpoint.pt" ]; then
        tail -n 1 "runs/$1/progress.csv" | awk -F, '{ printf "begun, %.1f M frames\n", $2 / 1e6 }'
    elif [ -e "results/unfinished/$1/progress.csv" ]; then
        echo "to do (unfinished/)"
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
        [ -e "$log" ] || fail "runs/$name was not begun by this script: move it away"
        resume=--resume
    fi
    echo "$name: $*" | tee -a "$log"
    if ! python train.py "$@" --ranks 1 --out "runs/$name" $resume >> "$log" 2>&1; then
        echo "$name: not finished, see $log"
        exit 255                                               # xargs starts no other run then
    fi
    numbers=0-9
    if [[ $name =~ -n[29](-paperworld-long)?-seed ]]; then
        numbers=0-9,14,19                                      # figure 3, and beyond
    fi
    if [[ $name =~ -mlp-n([0-9]+) ]]; then
        numbers=${BASH_REMATCH[1]}                             # it can play no other N
    fi
    python evaluate.py "runs/$name" --distractors "$numbers" --save >> "$log" 2>&1
    if [[ $name =~ -lrn-n2-seed ]]; then
        rm -rf "runs/$name-recentred"
        python results/recentre.py "runs/$name" "runs/$name-recentred"
        python evaluate.py "runs/$name-recentred" --distractors 0,2,5,9,14,19 --save >> "$log" 2>&1
        cp "runs/$name-recentred/zeroshot.csv" "results/recentred/$name.csv"
    fi
    python results/ship.py "runs/$name"
    echo "$name: done"
}

fail() {
    echo "reproduce.sh: error: $1" >&2
    exit 2
}

# A function, so that bash has read all of it before it runs: editing this file does no harm then.
# Each further run is started from the file as it stands at that moment.
main() {
    jobs=1
    list=
    pattern=
    while [ $# -gt 0 ]; do
        case $1 in
            --one) shift; one_run "$@"; exit ;;                # what xargs calls, in the last line
            --jobs) jobs=${2-}; shift; shift || true ;;
            --list) list=yes; shift ;;
            -*) fail "no option $1, only --list and --jobs" ;;
            *) [ -z "$pattern" ] || fail "one pattern, got $pattern $1: \"a|b\" names both"
               pattern=$1; shift ;;
        esac
    done
    [[ $jobs =~ ^[1-9][0-9]*$ ]] || fail "--jobs needs a number of runs"
    rows=$(all_runs | awk -v pattern="${pattern:-.}" '$1 ~ pattern')
    [ "$rows" ] || fail "no run's name matches $pattern"
    if [ "$list" ]; then
        while read -r name arguments; do
            printf "%-44s %-24s %s\n" "$name" "$(state_of "$name")" "$arguments"
        done <<< "$rows"
        exit
    fi
    left=$(while read -r name arguments; do
        [ "$(state_of "$name")" = "done" ] || echo "$name $arguments"
    done <<< "$rows")
    if [ "$left" ]; then
        xargs -P "$jobs" -L 1 results/reproduce.sh --one <<< "$left"
    else
        echo "done before; to train one anew, remove results/NAME and runs/NAME first"
    fi
}

main "$@"; exit
