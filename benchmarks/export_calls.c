/* Time of a call of a function behind CasADi's interface; see export.py. */
#define _POSIX_C_SOURCE 199309L
#include <time.h>

typedef int Function(const double **, double **, long long *, double *, int);

enum { CALLS = 10 };

static double now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

/* Least time of a call [s] over some turns, for knots calls one after the other, or 1 for all knots in one call.
   Arguments and results of a call follow those of the one before, as in CasADi's own maps. */
double least(Function *call, int calls, int inputs, const double **in, const long long *in_step, int outputs, double **out,
             const long long *out_step, const double **arg, double **res, long long *iw, double *w, int turns)
{
    double best = 1e9, begin, end;
    int turn, again, c, k;
    for (turn = 0; turn < turns; turn++) {
        begin = now();
        for (again = 0; again < CALLS; again++)
            for (c = 0; c < calls; c++) {
                for (k = 0; k < inputs; k++) arg[k] = in[k] ? in[k] + c * in_step[k] : 0;
                for (k = 0; k < outputs; k++) res[k] = out[k] ? out[k] + c * out_step[k] : 0;
                if (call(arg, res, iw, w, 0)) return -1;
            }
        end = now();
        if ((end - begin) / CALLS < best) best = (end - begin) / CALLS;
    }
    return best;
}
