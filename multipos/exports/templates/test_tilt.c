        $kind tilt[AXES];
        ${name}_tilt($call, tilt);
        for (int k = 0; k < AXES; ++k) {
            const $kind off = sin$f($turn * tilt[k]) - sin$f($turn * angle[i][k]);
            if (isnan(tilt[k]) != isnan(angle[i][k]) || off > $tolerance || -off > $tolerance) {
                printf("vector %d, axis %d: %g and not %g degrees\n", i + 1, k + 1,
                       (double)tilt[k], (double)angle[i][k]);
                failed = 1;
            }
        }
