/*
 * A control loop at a fixed rate. Controller and arm are functions that torchdq exported.
 *
 *     real_time CYCLES PERIOD_NS
 *
 * Prints a line for every cycle: how late the loop woke [ns], how long the controller computed [ns], and the positions of
 * the joints [rad]. The loop itself allocates and prints nothing.
 */
#define _POSIX_C_SOURCE 200112L
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#include "arm_control.h"
#include "arm_step.h"
#include "motion.h" /* JOINTS, MIDDLE [rad], SWING [rad], RATE [rad/s] */

#define MOST 100000
#define SECOND 1000000000L

static long late[MOST], computed[MOST];
static double positions[MOST][JOINTS];

static long between(struct timespec a, struct timespec b)
{
    return (long)(b.tv_sec - a.tv_sec) * SECOND + (b.tv_nsec - a.tv_nsec);
}

/* Desired motion: MIDDLE + SWING (1 - cos(RATE t)) / 2 */
static void desired(double t, double *q, double *qd, double *qdd)
{
    int i;
    for (i = 0; i < JOINTS; i++) {
        q[i] = MIDDLE[i] + 0.5 * SWING[i] * (1 - cos(RATE[i] * t));
        qd[i] = 0.5 * SWING[i] * RATE[i] * sin(RATE[i] * t);
        qdd[i] = 0.5 * SWING[i] * RATE[i] * RATE[i] * cos(RATE[i] * t);
    }
}

int main(int count, char **arguments)
{
    const long cycles = count == 3 ? atol(arguments[1]) : 0, period = count == 3 ? atol(arguments[2]) : 0;
    double q[JOINTS], qd[JOINTS], tau[JOINTS], q_des[JOINTS], qd_des[JOINTS], qdd_des[JOINTS], growth[1];
    struct timespec due, woken, done;
    long k;
    int i;

    if (cycles < 1 || cycles > MOST || period < 1 || period >= SECOND) {
        fprintf(stderr, "usage: real_time CYCLES PERIOD_NS, with 1 to %d cycles of less than a second\n", MOST);
        return 2;
    }
    memcpy(q, MIDDLE, sizeof q);
    memset(qd, 0, sizeof qd);
    clock_gettime(CLOCK_MONOTONIC, &due);
    for (k = 0; k < cycles; k++) {
        due.tv_nsec += period;
        if (due.tv_nsec >= SECOND) {
            due.tv_nsec -= SECOND;
            due.tv_sec++;
        }
        while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &due, NULL)) {
        }
        clock_gettime(CLOCK_MONOTONIC, &woken);
        desired(1e-9 * (double)period * (double)k, q_des, qd_des, qdd_des);
        if (arm_control(q, qd, q_des, qd_des, qdd_des, tau)) {
            fprintf(stderr, "a torque is not finite in cycle %ld\n", k);
            return 1;
        }
        clock_gettime(CLOCK_MONOTONIC, &done);
        late[k] = between(due, woken);
        computed[k] = between(woken, done);
        if (arm_step(q, qd, tau, q, qd, growth)) {
            fprintf(stderr, "the arm's mass matrix is singular in cycle %ld\n", k);
            return 1;
        }
        memcpy(positions[k], q, sizeof q);
    }
    for (k = 0; k < cycles; k++) {
        printf("%ld %ld", late[k], computed[k]);
        for (i = 0; i < JOINTS; i++) printf(" %.17g", positions[k][i]);
        printf("\n");
    }
    return 0;
}
