"""Proximal Policy Optimisation (Schulman et al., 2017; appendix A.2) in one process or several.

    L = -E[min(ratio A_t, clip(ratio, 1 - eps, 1 + eps) A_t)]      A_t advantages, eps `clip`
        + c_v E[(V - R)^2] / 2                                     c_v `value_coef`
        - c_e H                                                    c_e `entropy`, H the entropy
        + c_a auxiliary loss                                       c_a `auxiliary`

For dict observations and continuous actions. It asks
- of a network, agent(obs) -> mean (n, A), log_std (A,), a parameter, and value (n,), for any n
  observations; if c_a > 0 also agent.auxiliary(obs), a loss
- of an environment, Gymnasium's reset and step; it has to clip actions, samples of a Gaussian.
Every rollout starts with fresh episodes: with T below an episode's length no end is ever seen.
A rank is one of the processes that train together: each steps its own environments, and they
average gradients and the moments of advantages and returns over torch.distributed (as DD-PPO
does), so many ranks give the gradient of one on the joined minibatch.

Shapes: T steps of a rollout, E environments of this rank, B = T * E samples, A actions.
        What a rollout stores is (T, E, ...).
Run:    python ppo.py        learns to reach a random point on a line, in ten seconds
"""
import math

import numpy as np
import torch
import torch.distributed as dist
from torch import nn


def gae(rewards, values, next_values, terminated, is_last, discount, lam):
    """Generalised advantage estimation (Schulman et al., 2016): inputs (T, E) -> advantages (T, E).

    next_values[t] is the value of the observation that step t led to. At the end of an episode
    that is its final observation, not the first one of the next episode. After a termination there
    is no future, so delta leaves next_values out; after a truncation there is one, so it keeps
    them. `is_last` marks the end of an episode, for either reason, or of the rollout: from there
    A_{t+1} is not carried back. (Like `terminated` it holds 0.0 and 1.0.)
    """
    advantages = torch.zeros_like(rewards)
    following = torch.zeros_like(rewards[0])                   # A_{t+1}, (E,)
    for t in reversed(range(len(rewards))):
        # delta_t = r_t + gamma V(s_{t+1}) - V(s_t),   A_t = delta_t + gamma lambda A_{t+1}
        delta = rewards[t] + discount * (1 - terminated[t]) * next_values[t] - values[t]
        advantages[t] = delta + discount * lam * (1 - is_last[t]) * following
        following = advantages[t]
    return advantages


def normal_log_prob(actions, mean, log_std):
    """Log density (...) of actions (..., A) under a Gaussian with independent components."""
    scaled = (actions - mean) * torch.exp(-log_std)
    log_density = -0.5 * scaled ** 2 - log_std - 0.5 * math.log(2 * math.pi)           # (..., A)
    return log_density.sum(-1)


def rank_mean(tensor):
    """Mean of a tensor over all ranks, in place; with one rank the tensor itself."""
    if dist.is_initialized():
        dist.all_reduce(tensor)
        tensor /= dist.get_world_size()
    return tensor


class PPO(nn.Module):
    """The learner: agent, optimiser and value normaliser. Defaults suit small problems such as the
    example below.

    A module, so that its state dict holds the agent and the running moments of the returns.

    minibatches, epochs    the batch is cut into equal parts and passed over `epochs` times;
                           ValueError unless `minibatches` divides T * E
    lr_power               the learning rate falls as lr x (share of training left) ^ lr_power:
                           1 linearly, 0 not at all
    anneal_clip            multiply the clip range by the share of training left
    normalize_advantages   to mean 0 and standard deviation 1 over the whole batch of all ranks
    normalize_values       the value network learns (return - running mean) / running std

    Random numbers come from torch's global generator: seed it before rollout() and an update
    repeats exactly.
    """

    def __init__(self, agent, envs, *, steps=250, epochs=5, minibatches=8, lr=1e-3, adam_eps=1e-5,
                 clip=0.2, discount=0.98, lam=0.95, entropy=0.001, value_coef=0.5,
                 max_grad_norm=0.5, lr_power=1.0, anneal_clip=False, normalize_advantages=True,
                 normalize_values=True, auxiliary=0.0):
        super().__init__()
        if (steps * len(envs)) % minibatches:
            raise ValueError(f"a batch of {steps} steps x {len(envs)} environments does not divide "
                             f"into {minibatches} minibatches")
        self.agent, self.envs = agent, envs
        self.steps, self.epochs, self.minibatches = steps, epochs, minibatches
        self.lr, self.lr_power = lr, lr_power
        self.clip, self.anneal_clip = clip, anneal_clip
        self.discount, self.lam = discount, lam
        self.entropy_coef, self.value_coef, self.auxiliary_coef = entropy, value_coef, auxiliary
        self.max_grad_norm = max_grad_norm
        self.normalize_advantages, self.normalize_values = normalize_advantages, normalize_values
        self.register_buffer("return_mean", torch.zeros(()))
        self.register_buffer("return_square", torch.ones(()))
        self.register_buffer("return_batches", torch.zeros(()))
        self.optimizer = torch.optim.Adam(agent.parameters(), lr=lr, eps=adam_eps, fused=True)

    def return_std(self):
        variance = self.return_square - self.return_mean ** 2
        return variance.clamp(min=1e-8).sqrt()

    # ---- playing

    @torch.no_grad()
    def rollout(self, seeds):
        """Play T steps in every environment, environment e from reset(seed=seeds[e]).

        Starting fresh makes an update a function of these seeds, torch's generator and the state
        of learner and optimiser, which is what lets a run resume exactly. Leaves the batch for
        update() in self.observations and self.batch, and self.explained_variance for its
        diagnostics. Returns the finished episodes: dicts with "return", "length" and "info", that
        of the last step.
        """
        played, final_observations, episodes = self.play(seeds)
        values = played.pop("values")
        next_values = self.bootstrap_values(values, final_observations)
        if self.normalize_values:        # from the network's units to those of the rewards
            values = values * self.return_std() + self.return_mean
            next_values = next_values * self.return_std() + self.return_mean
        advantages = gae(played.pop("rewards"), values, next_values, played.pop("terminated"),
                         played.pop("is_last"), self.discount, self.lam)
        returns = advantages + values                          # R, lambda-returns: V learns them
        # 1 - Var[R - V] / Var[R]
        self.explained_variance = 1 - advantages.var() / returns.var().clamp(min=1e-8)
        self.batch = {**played, "advantages": advantages, "returns": returns}
        return episodes

    def play(self, seeds):
        """Play T steps in every environment.

        Returns what happened (dict of (T, E, ...) tensors), the final observations
        {(t, e): observation} wherever an episode or the rollout ended, and the finished episodes.
        """
        T, E = self.steps, len(self.envs)
        current = [env.reset(seed=seed)[0] for env, seed in zip(self.envs, seeds)]
        self.observations = {key: torch.empty(T, E, *value.shape)
                             for key, value in current[0].items()}
        rewards, terminations, is_last = (np.zeros((T, E), np.float32) for _ in range(3))
        actions, means, values = [], [], []
        final_observations, episodes = {}, []
        total, length = np.zeros(E), np.zeros(E, int)          # of the episodes under way
        for t in range(T):
            for key, stored in self.observations.items():
                stored[t] = torch.from_numpy(np.stack([obs[key] for obs in current]))
            mean, log_std, value = self.agent({key: x[t] for key, x in self.observations.items()})
            if t == 0:                                         # one draw for all T steps
                noise = torch.randn(T, *mean.shape) * log_std.exp()        # (T, E, A)
            means.append(mean)
            values.append(value)
            actions.append(mean + noise[t])
            for e, action in enumerate(actions[t].numpy()):
                current[e], reward, terminated, truncated, info = self.envs[e].step(action)
                rewards[t, e] = reward
                terminations[t, e] = terminated
                total[e] += rewards[t, e]                      # as float32, as it is learned from
                length[e] += 1
                ended = terminated or truncated
                if ended or t == T - 1:
                    is_last[t, e] = True
                    # Copied: an environment may use its arrays again.
                    final_observations[t, e] = {key: np.array(value, np.float32)
                                                for key, value in current[e].items()}
                if ended:
                    episodes.append({"return": total[e], "length": int(length[e]), "info": info})
                    total[e] = length[e] = 0
                if ended and t < T - 1:                        # the next rollout() resets anyway
                    current[e], _ = self.envs[e].reset()
        actions = torch.stack(actions)
        played = {"rewards": torch.from_numpy(rewards), "values": torch.stack(values),
                  "terminated": torch.from_numpy(terminations), "actions": actions,
                  "is_last": torch.from_numpy(is_last),
                  "old_log_prob": normal_log_prob(actions, torch.stack(means), log_std)}
        return played, final_observations, episodes

    def bootstrap_values(self, values, final_observations):
        """V(s_{t+1}) (T, E): the next row of `values`, or the value of a final observation."""
        # Wrong where an episode ended and in the last row: there goes a final observation's value.
        next_values = values.roll(-1, dims=0)
        observations = final_observations.values()
        finals = {key: torch.from_numpy(np.stack([final[key] for final in observations]))
                  for key in self.observations}
        _, _, value = self.agent(finals)
        t, e = torch.tensor(list(final_observations)).T        # its keys are (t, e)
        next_values[t, e] = value
        return next_values

    # ---- learning

    def update(self, remaining):
        """Improve the agent on the last rollout; `remaining` is the share of training to come.

        Returns the mean diagnostics. FloatingPointError if a gradient is not finite; the weights
        are then as before that step.
        """
        lr = self.lr * remaining ** self.lr_power
        clip = self.clip * remaining if self.anneal_clip else self.clip
        for group in self.optimizer.param_groups:
            group["lr"] = lr
        batch = self.normalized_batch()
        observations = {key: value.flatten(0, 1) for key, value in self.observations.items()}
        stats = []
        for _ in range(self.epochs):
            for indices in torch.randperm(len(batch["returns"])).chunk(self.minibatches):
                minibatch = {key: value[indices] for key, value in batch.items()}
                obs = {key: value[indices] for key, value in observations.items()}
                stats.append(self.minibatch_step(obs, minibatch, clip))
        means = {key: torch.stack([each[key] for each in stats]).mean() for key in stats[0]}
        means["explained_variance"] = self.explained_variance
        averages = rank_mean(torch.stack(list(means.values())))
        return {**dict(zip(means, averages.tolist())), "lr": lr}

    def normalized_batch(self):
        """The last rollout as (B, ...) tensors, returns and advantages normalised if asked for.

        Also updates the running moments. rollout() scaled the values with the old moments; the
        targets here are normalised with the new ones. After the first few updates both are close.
        """
        batch = {key: value.flatten(0, 1) for key, value in self.batch.items()}
        returns, advantages = batch["returns"], batch["advantages"]
        moments = rank_mean(torch.stack([
            returns.mean(), returns.square().mean(), advantages.mean(), advantages.square().mean()
        ]))
        return_mean, return_square, advantage_mean, advantage_square = moments
        if self.normalize_values:
            # Running moments: the plain mean at first, then over about 100 batches.
            self.return_batches += 1
            rate = max(1 / self.return_batches.item(), 0.01)
            self.return_mean += rate * (return_mean - self.return_mean)
            self.return_square += rate * (return_square - self.return_square)
            batch["returns"] = (returns - self.return_mean) / self.return_std()
        if self.normalize_advantages:
            std = (advantage_square - advantage_mean ** 2).clamp(min=0).sqrt()
            batch["advantages"] = (advantages - advantage_mean) / (std + 1e-8)
        return batch

    def minibatch_step(self, obs, minibatch, clip):
        """One step of Adam on one minibatch, with the gradient averaged over ranks and clipped."""
        loss, stats = self.loss(obs, clip=clip, **minibatch)
        self.optimizer.zero_grad()
        loss.backward()
        weights = [p for p in self.agent.parameters() if p.grad is not None]
        if dist.is_initialized():                              # all gradients in one message
            gradient = rank_mean(torch.cat([p.grad.flatten() for p in weights]))
            for p, mean in zip(weights, gradient.split([p.numel() for p in weights])):
                p.grad.copy_(mean.view_as(p))
        norm = nn.utils.clip_grad_norm_(weights, self.max_grad_norm)
        if not torch.isfinite(norm):
            raise FloatingPointError(f"the gradient is not finite (loss {loss.item()})")
        self.optimizer.step()
        return {**stats, "grad_norm": norm}

    def loss(self, obs, actions, old_log_prob, advantages, returns, clip):
        """PPO's loss on one minibatch (the module's first lines) and its diagnostics."""
        mean, log_std, value = self.agent(obs)
        log_ratio = normal_log_prob(actions, mean, log_std) - old_log_prob
        ratio = log_ratio.exp()                                # pi(a|s) / pi_old(a|s)

        # L_policy = -E[min(ratio A_t, clip(ratio, 1 - eps, 1 + eps) A_t)]
        clipped = ratio.clamp(1 - clip, 1 + clip)
        policy_loss = -torch.min(ratio * advantages, clipped * advantages).mean()
        # L_value = E[(V - R)^2] / 2
        value_loss = 0.5 * (value - returns).square().mean()
        # H of a Gaussian: sum_j (log sigma_j + log(2 pi e) / 2)
        entropy = (log_std + 0.5 * math.log(2 * math.pi * math.e)).sum()
        auxiliary_loss = self.agent.auxiliary(obs) if self.auxiliary_coef else torch.zeros(())
        loss = (policy_loss + self.value_coef * value_loss - self.entropy_coef * entropy
                + self.auxiliary_coef * auxiliary_loss)

        # KL(pi_old || pi) = E[(ratio - 1) - log ratio]: never negative ("k3", Schulman, 2020)
        approx_kl = ((ratio - 1) - log_ratio).mean()
        clip_fraction = ((ratio - 1).abs() > clip).float().mean()
        stats = {"policy_loss": policy_loss, "value_loss": value_loss,
                 "auxiliary_loss": auxiliary_loss, "entropy": entropy,
                 "approx_kl": approx_kl, "clip_fraction": clip_fraction}
        return loss, {name: value.detach() for name, value in stats.items()}


# ---- an example

class PointOnLine:
    """A 1-D example: move a point by at most 0.2 a step to within 0.1 of a target."""

    def reset(self, *, seed=None, options=None):
        if seed is not None:
            self.rng = np.random.default_rng(seed)
        self.x, self.target = self.rng.uniform(-1, 1, 2)
        self.steps = 0
        return self.observation(), {}

    def step(self, action):
        self.x += 0.2 * float(np.clip(action[0], -1, 1))
        self.steps += 1
        gap = abs(self.x - self.target)
        terminated = bool(gap < 0.1)
        truncated = self.steps >= 20
        return self.observation(), -gap, terminated, truncated, {"gap": gap}

    def observation(self):
        return {"x": np.array([self.x, self.target], np.float32)}


class TinyAgent(nn.Module):
    """Two small networks and a free standard deviation: the agent contract in ten lines."""

    def __init__(self):
        super().__init__()
        self.mean = nn.Sequential(nn.Linear(2, 32), nn.Tanh(), nn.Linear(32, 1))
        self.value = nn.Sequential(nn.Linear(2, 32), nn.Tanh(), nn.Linear(32, 1))
        self.log_std = nn.Parameter(torch.full((1,), -0.5))

    def forward(self, obs):
        return self.mean(obs["x"]), self.log_std, self.value(obs["x"]).squeeze(-1)


if __name__ == "__main__":
    torch.set_num_threads(1)             # more do not pay on networks this small
    torch.manual_seed(0)
    learner = PPO(TinyAgent(), [PointOnLine() for _ in range(8)], steps=64, lr=3e-3)
    for update in range(30):
        episodes = learner.rollout([1000 * update + e for e in range(8)])
        stats = learner.update(1 - update / 30)
        if update % 5 == 4:
            mean_return = np.mean([episode["return"] for episode in episodes])
            print(f"update {update + 1:2d}: mean return {mean_return:6.2f}, KL "
                  f"{stats['approx_kl']:.4f}, variance explained {stats['explained_variance']:.2f}")
