/* Parts of a domain with too many or too few generators, by the potential of the displacements that would even this
   out. One work-item per generator.

   Cell i should have V_i rho_i generators, and has one. Displacements u = -grad phi carry the surplus away if

       sum_j l_ij / d_ij (phi_i - phi_j) = V_i rho_i - 1 - mean,      E = 1/2 sum_i phi_i (V_i rho_i - 1),

   in numbers of cells: E is half the sum of |u|^2 / h^2 over the cells. It is large where displacements have to carry
   whole cells through a narrow part. A generator that is inserted at i (s = 1) or deleted (s = -1) lowers E by
   s (phi_i + phi_i') / 2, with the potential phi' after the change. An `offset` of the potential favors changes that
   correct the number of all generators. */
#include "adaptation/site_key.h"

/* |phi| that a site at a wall has to have beyond that of an inner one: in passages one or two cells wide there are no
   others. */
#define WALL_COST R(1)

/* Sites: cells with |phi + offset| above `least`, which are not `blocked`. The largest comes first; inner cells are
   preferred, for insertion large ones of many faces, for deletion small ones of few faces. */
kernel void score_potential(const int size, global const int *starts, global const int *neighbors,
                            global const REAL *log_ratio, global const REAL *potential, const REAL offset,
                            const REAL least, global const ulong *blocked, NAME_ARGS, global ulong *keys)
{
    WORK_ITEM(i);
    const REAL phi = potential[i] + offset, sign = phi > 0 ? 1 : -1;
    bool site = fabs(phi) > least && blocked[i] == 0, inner = true;
    for (int k = starts[i]; k < starts[i + 1] && inner; ++k)
        inner = neighbors[k] >= 0;
    const REAL magnitude =
        fabs(phi) + sign * need_of_split(log_ratio[i], starts[i + 1] - starts[i]) - (inner ? 0 : WALL_COST);
    keys[i] = site && magnitude > 0 ? site_key(magnitude, NAME(i)) : 0;
}

/* before = potential; rhs = V rho - 1 - changes, with changes at the `chosen` sites, too. */
kernel void try_changes(const int size, global const REAL *weight, global const int *changes,
                        global const ulong *chosen, global const REAL *potential, const REAL offset,
                        global REAL *before, global REAL *rhs)
{
    WORK_ITEM(i);
    const REAL phi = potential[i];
    const int change = chosen[i] == 0 ? 0 : phi + offset > 0 ? 1 : -1;
    before[i] = phi;
    rhs[i] = weight[i] - 1 - changes[i] - change;
}

/* Accept changes at `chosen` sites that gain at least `least`. `blocked` collects all chosen sites, and `accepted` the
   numbers of insertions and deletions. */
kernel void accept_changes(const int size, global const ulong *chosen, global const REAL *before,
                           global const REAL *after, const REAL offset, const REAL least, global int *changes,
                           global ulong *blocked, global int *accepted)
{
    WORK_ITEM(i);
    if (chosen[i] == 0)
        return;
    const int change = before[i] + offset > 0 ? 1 : -1;
    blocked[i] = 1;
    if (change * ((before[i] + after[i]) / 2 + offset) < least)
        return;
    changes[i] += change;
    atomic_inc(accepted + (change < 0));
}

/* sites = 1 where changes have this sign. */
kernel void select_changes(const int size, global const int *changes, const int sign, global ulong *sites)
{
    WORK_ITEM(i);
    sites[i] = changes[i] == sign;
}
