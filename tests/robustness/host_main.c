/* Runs recorded launches of OpenCL kernels on the host: host_main JOB ... Built by sanitized.py with a sanitizer,
   together with the kernels of one program. Buffers are as long as on the device, to the byte, so that AddressSanitizer
   sees what lies beyond. Work-items run one after the other; those of a group at once, as threads, where barriers may
   be met. For every job it prints its name, how many bytes of integers differ from what the device had written, the
   largest relative difference of real numbers, and how many bytes were written that depend on uninitialized memory. A
   job is what `write_job` of sanitized.py says. After the relative difference comes the absolute one of that buffer. */
#define _GNU_SOURCE
#include <math.h>
#include <pthread.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#ifdef MEMORY_SANITIZER
#include <sanitizer/msan_interface.h>
#define FORWARDS 1
#else
#define FORWARDS 0
#endif

typedef struct {
    const char *name;
    void (*launch)(uint64_t *);
} kernel_t;
extern const kernel_t kernels[];

static __thread size_t item_local, item_group;
static size_t group_size, groups;
static pthread_barrier_t group_barrier;

size_t get_local_id(unsigned axis)
{
    return axis ? 0 : item_local;
}

size_t get_group_id(unsigned axis)
{
    return axis ? 0 : item_group;
}

size_t get_global_id(unsigned axis)
{
    return axis ? 0 : item_group * group_size + item_local;
}

size_t get_num_groups(unsigned axis)
{
    return axis ? 1 : groups;
}

size_t get_local_size(unsigned axis)
{
    return axis ? 1 : group_size;
}

size_t get_global_size(unsigned axis)
{
    return axis ? 1 : groups * group_size;
}

void barrier(unsigned flags)
{
    (void)flags;
    if (group_size > 1)
        pthread_barrier_wait(&group_barrier);
}

typedef struct {
    size_t local, group;
    void (*launch)(uint64_t *);
    uint64_t *args;
} item_t;

static void *run_item(void *of)
{
    const item_t *item = of;
    item_local = item->local;
    item_group = item->group;
    item->launch(item->args);
    return NULL;
}

static void run_group(size_t group, void (*launch)(uint64_t *), uint64_t *args, int at_once)
{
    item_t *items = malloc(group_size * sizeof *items);
    pthread_t *threads = malloc(group_size * sizeof *threads);
    if (at_once)
        pthread_barrier_init(&group_barrier, NULL, group_size);
    for (size_t k = 0; k < group_size; ++k) {
        const size_t i = FORWARDS ? k : group_size - 1 - k;
        items[i] = (item_t){i, group, launch, args};
        if (!at_once)
            run_item(items + i);
        else if (pthread_create(threads + i, NULL, run_item, items + i))
            abort();
    }
    for (size_t i = 0; at_once && i < group_size; ++i)
        pthread_join(threads[i], NULL);
    if (at_once)
        pthread_barrier_destroy(&group_barrier);
    free(threads);
    free(items);
}

static int64_t read_int(FILE *file)
{
    int64_t value;
    if (fread(&value, sizeof value, 1, file) != 1)
        abort();
    return value;
}

/* Aligned as OpenCL's largest type asks for. */
static char *read_block(FILE *file, int64_t size)
{
    void *block;
    if (posix_memalign(&block, 128, size) || fread(block, 1, size, file) != (size_t)size)
        abort();
    return block;
}

static double real_number(const char *at, int64_t bytes)
{
    double x;
    float x4;
    if (bytes == 8)
        return memcpy(&x, at, 8), x;
    return memcpy(&x4, at, 4), x4;
}

/* The largest difference of real numbers of so many bytes over the largest number that is expected; infinity where one
   is no number and the other is. What stands in for an array that is not used may end within a number. `absolute`
   becomes the difference itself. */
static double difference(const char *expected, const char *found, int64_t size, int64_t bytes, double *absolute)
{
    double most = 0, largest = 0;
    for (int64_t k = 0; k + bytes <= size; k += bytes) {
        const double x = real_number(expected + k, bytes), y = real_number(found + k, bytes);
        if (isfinite(x))
            largest = fmax(largest, fabs(x));
        if (x != y && !(isnan(x) && isnan(y)))
            most = fmax(most, isfinite(x - y) ? fabs(x - y) : INFINITY);
    }
    *absolute = most;
    return most == 0 ? 0 : most / largest;
}

static void run_job(const char *path)
{
    FILE *file = fopen(path, "rb");
    if (!file)
        abort();
    const int64_t length = read_int(file);
    char *name = read_block(file, length + 1);
    const int at_once = read_int(file);
    group_size = read_int(file);
    groups = read_int(file);
    const int64_t n_buffers = read_int(file);
    char **buffers = malloc(n_buffers * sizeof *buffers);
    int64_t *sizes = malloc(n_buffers * sizeof *sizes), *reals = malloc(n_buffers * sizeof *reals);
    for (int64_t b = 0; b < n_buffers; ++b) {
        reals[b] = read_int(file);
        sizes[b] = read_int(file);
        buffers[b] = read_block(file, sizes[b]);
    }
    const int64_t n_args = read_int(file);
    uint64_t *args = malloc(n_args * sizeof *args);
    int64_t *of = malloc(n_args * sizeof *of);
    for (int64_t a = 0; a < n_args; ++a) {
        of[a] = read_int(file);
        args[a] = of[a] < 0 ? (uint64_t)read_block(file, -of[a]) : (uint64_t)buffers[of[a]];
    }
    const kernel_t *kernel = kernels;
    while (kernel->name && strcmp(kernel->name, name))
        ++kernel;
    if (!kernel->name)
        abort();
    /* Under one sanitizer forwards, under the other backwards: nothing may follow from the order. */
    for (size_t k = 0; k < groups; ++k)
        run_group(FORWARDS ? k : groups - 1 - k, kernel->launch, args, at_once);
    int64_t differing = 0, unwritten = 0;
    double most = 0, absolute = 0;
    for (int64_t b = 0; b < n_buffers; ++b) {
#ifdef MEMORY_SANITIZER
        const intptr_t at = __msan_test_shadow(buffers[b], sizes[b]);
        if (at >= 0)
            unwritten += sizes[b] - at;
        __msan_unpoison(buffers[b], sizes[b]);
#endif
        char *expected = read_block(file, sizes[b]);
        if (reals[b]) {
            double own;
            const double ratio = difference(expected, buffers[b], sizes[b], reals[b], &own);
            absolute = ratio > most ? own : absolute;
            most = fmax(most, ratio);
        }
        for (int64_t k = 0; !reals[b] && k < sizes[b]; ++k)
            differing += expected[k] != buffers[b][k];
        free(expected);
    }
    printf("%s %lld %.3g %.3g %lld\n", path, (long long)differing, most, absolute, (long long)unwritten);
    fflush(stdout);
    for (int64_t a = 0; a < n_args; ++a)
        if (of[a] < 0)
            free((void *)args[a]);
    for (int64_t b = 0; b < n_buffers; ++b)
        free(buffers[b]);
    free(of);
    free(args);
    free(reals);
    free(sizes);
    free(buffers);
    free(name);
    fclose(file);
}

int main(int count, char **paths)
{
    for (int k = 1; k < count; ++k)
        run_job(paths[k]);
    return 0;
}
