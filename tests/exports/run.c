#include <stdint.h>
#include <stdio.h>
$declaration;
int main(void)
{
    double row[$columns], out[$axes];
    FILE *readings = fopen("readings", "rb"), *forces = fopen("forces", "wb");
    if (readings == NULL || forces == NULL) return 1;
    while (fread(row, sizeof row, 1, readings) == 1) {
        $kind raw[$raw], accel[$axes];
        for (int i = 0; i < $raw; ++i) raw[i] = ($kind)row[i];
        $environment
        ${name}_compensate(raw, ${between}accel);
        for (int k = 0; k < $axes; ++k) out[k] = (double)accel[k];
        if (fwrite(out, sizeof out, 1, forces) != 1) return 1;
    }
    return fclose(forces) ? 1 : 0;
}
