/* The report of the kernels that make or update a diagram, in 2D and in 3D: numbers that the host reads. */
#define REPORT_FLAGS 0      /* bits, below */
#define REPORT_FACES 1      /* in 3D: faces of cells that are not matched yet */
#define REPORT_UNFINISHED 2 /* cells that remain to be clipped */
#define REPORT_MARKED 3     /* cells that an update must repeat; in 2D whether there are any */
#define REPORT_KEPT 4       /* half-faces of the diagram */
#define REPORT_LISTED 5     /* cells that each round of an update repeats; in 2D those of all rounds before */
#define REPORT_PLACED 13    /* in 3D: listed cells */
#define REPORT_SPARE 14     /* in 2D: next spare slot, and number of slots */
#define REPORT_SLOTS 15
#define REPORT_WHOLE 16 /* in 2D: whether faces no longer than round-off stay */
#define REPORT_WRONG 17 /* in 2D: wrong rows of a sample */

#define FLAG_FULL 1      /* a cell has more faces than there is room for */
#define FLAG_COINCIDE 2  /* two generators at the same place */
#define FLAG_COLLAPSED 4 /* generators too close for the precision */
#define FLAG_DOUBT 8     /* no error: there are doubtful cells, whose faces must be matched */
#define FLAG_NARROW 16   /* no error: some faces may be no wider than round-off; see consistency.cl */
#define FLAG_LOOPED 32   /* faces cross */
#define FLAG_UNEVEN 64   /* no error: two cells differ about their common face by more than a small share of one */
#define FLAG_UNKNOWN 128 /* the surface of a solid is not known as far as a cell reaches */
#define FLAG_OPEN 256    /* a cell on the sphere is not enclosed by generators */
