"""Recording of a few watched worlds after every policy step, for viewers of a running training."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.struct
class WatchedSource:
    """Values of all worlds that are recorded, as 32-bit words of any type."""

    words: wp.array2d(dtype=wp.int32)  # (num_worlds, width)


@wp.kernel
def watched_kernel(
    # in
    step: int,
    worlds: wp.array(dtype=wp.int32),
    sources: wp.array(dtype=WatchedSource),
    source_of: wp.array(dtype=wp.int32),
    word_of: wp.array(dtype=wp.int32),
    reward: wp.array(dtype=float),
    done: wp.array(dtype=float),
    # out
    running_return: wp.array(dtype=float),
    last_return: wp.array(dtype=float),
    words: wp.array3d(dtype=wp.int32),
):
    """Copy the words of watched worlds to row `step` of a buffer, and update the episode returns of all worlds.

    worlds: (slots,) indices. source_of, word_of: (columns,) source and its word in each column of `words`,
    (steps, slots, columns). reward, done, running_return, last_return: (num_worlds,).
    """
    i = wp.tid()
    if i < reward.shape[0]:
        total = running_return[i] + wp.where(wp.isfinite(reward[i]), reward[i], 0.0)
        if done[i] > 0.0:
            last_return[i] = total
            total = 0.0
        running_return[i] = total
    slot = i // word_of.shape[0]
    column = i % word_of.shape[0]
    if slot < worlds.shape[0]:
        words[step, slot, column] = sources[source_of[column]].words[worlds[slot], word_of[column]]
