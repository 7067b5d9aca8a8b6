/* target[i] = source[i], with all compute units: a measure of the bandwidth. One work-item copies 16 bytes. */
kernel void copy_words(global const uint4 *source, global uint4 *target)
{
    const size_t i = get_global_id(0);
    target[i] = source[i];
}
