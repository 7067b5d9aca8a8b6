/* Sort a short list in place, by Shell's method. */
inline void sort_list(global int *list, int count)
{
    int gap = 1;
    while (gap < count / 9)
        gap = 3 * gap + 1;
    for (; gap > 0; gap /= 3)
        for (int k = gap; k < count; ++k) {
            const int item = list[k];
            int at = k;
            for (; at >= gap && list[at - gap] > item; at -= gap)
                list[at] = list[at - gap];
            list[at] = item;
        }
}
