/* target[i] = source[i]: a copy that reads and writes memory with all compute units, to measure the bandwidth by. One
   work-item stands for 16 bytes. */
kernel void copy_words(global const uint4 *source, global uint4 *target)
{
    const size_t i = get_global_id(0);
    target[i] = source[i];
}
