/* A team: TEAM work-items, the members, that build one cell together. It is a work-group.

   All members take the same branches around the functions below, and get the same answer. With -DWARP_ASM=1 a team is a
   warp of an NVIDIA GPU of compute capability 8 or more, and its instructions do the work (bar.warp.sync, redux.sync,
   vote.sync, shfl.sync: see NVIDIA's PTX ISA). Elsewhere members exchange words in local memory. */
#include "opencl/real.h"

#define TEAM 32 /* a bit of a word for each member */
#define BELOW(member) (((uint)1 << (member)) - 1)

/* Of a kernel: its groups are teams. */
#define TEAM_GROUP __attribute__((reqd_work_group_size(TEAM, 1, 1)))

/* All members have come here, and see what the others have written. */
#ifdef WARP_ASM
#define TEAM_SYNC() __asm__ volatile("bar.warp.sync 0xffffffff;" : : : "memory")
#else
#define TEAM_SYNC() barrier(CLK_LOCAL_MEM_FENCE | CLK_GLOBAL_MEM_FENCE)
#endif

/* A member's view of its team. A reduction collects in word number `turn`; this one and the next are zero before. */
typedef struct {
    local uint *words; /* 3 + TEAM */
    int lane, turn;    /* lane: the number of the member */
} team_t;

/* Clear the next word, and return the one to collect in. With three words in turn a reduction needs one barrier. */
inline local uint *next_word(team_t *team)
{
    local uint *word = team->words + team->turn;
    team->turn = team->turn == 2 ? 0 : team->turn + 1;
    if (team->lane == 0)
        team->words[team->turn] = 0;
    return word;
}

/* The bits of all members. */
inline uint team_or(team_t *team, uint bits)
{
#ifdef WARP_ASM
    uint all;
    __asm__ volatile("redux.sync.or.b32 %0, %1, 0xffffffff;" : "=r"(all) : "r"(bits));
    return all;
#else
    local uint *word = next_word(team);
    if (bits != 0)
        atomic_or(word, bits);
    TEAM_SYNC();
    return *word;
#endif
}

/* The largest number of a member. */
inline uint team_max(team_t *team, uint number)
{
#ifdef WARP_ASM
    uint most;
    __asm__ volatile("redux.sync.max.u32 %0, %1, 0xffffffff;" : "=r"(most) : "r"(number));
    return most;
#else
    local uint *word = next_word(team);
    if (number != 0)
        atomic_max(word, number);
    TEAM_SYNC();
    return *word;
#endif
}

/* One bit per member. */
inline uint team_ballot(team_t *team, bool bit)
{
#ifdef WARP_ASM
    uint all;
    __asm__ volatile("{\n .reg .pred p;\n setp.ne.u32 p, %1, 0;\n vote.sync.ballot.b32 %0, p, 0xffffffff;\n}"
                     : "=r"(all)
                     : "r"((uint)bit));
    return all;
#else
    return team_or(team, (uint)bit << team->lane);
#endif
}

/* The largest of numbers that are not negative: their bits have the same order as integers. */
inline REAL team_largest(team_t *team, REAL number)
{
#if IS_DOUBLE
    const ulong bits = as_ulong(number);
    const uint high = (uint)(bits >> 32), most = team_max(team, high);
    const uint low = team_max(team, high == most ? (uint)bits : 0);
    return as_double(((ulong)most << 32) | low);
#else
    return as_float(team_max(team, as_uint(number)));
#endif
}

/* The sum of the numbers of the members before this one; `total` becomes that of all. */
inline int team_scan(team_t *team, int number, int *total)
{
#ifdef WARP_ASM
    int sum = number;
    for (int step = 1; step < TEAM; step *= 2) {
        int other;
        __asm__ volatile("shfl.sync.up.b32 %0, %1, %2, 0, 0xffffffff;" : "=r"(other) : "r"(sum), "r"(step));
        sum += team->lane >= step ? other : 0;
    }
    __asm__ volatile("shfl.sync.idx.b32 %0, %1, 31, 31, 0xffffffff;" : "=r"(*total) : "r"(sum));
    return sum - number;
#else
    local int *numbers = (local int *)(team->words + 3);
    numbers[team->lane] = number;
    TEAM_SYNC();
    int before = 0, all = 0;
    for (int k = 0; k < TEAM; ++k) {
        before += k < team->lane ? numbers[k] : 0;
        all += numbers[k];
    }
    TEAM_SYNC();
    *total = all;
    return before;
#endif
}
