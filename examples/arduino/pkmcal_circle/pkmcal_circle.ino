/* A parallel machine on a circle, by the C source of pkmcal.
 *
 *   pkmcal export bench/calibration --to c -o c
 *   cp c/pkmcal_kinematics.h c/pkmcal_kinematics.c examples/arduino/pkmcal_circle/
 *
 * The sketch prints, every tenth of a second, where the platform is to be and the readings that put
 * it there, such as for the drivers of your motors; and how long both directions of kinematics took.
 * Where a float is enough and the controller counts in floats alone (Cortex-M4F), remove the comment
 * around "#define PKMCAL_FLOAT" in the header; an AVR's double is a float as it is.
 */
#include <math.h>

#include "pkmcal_kinematics.h"

static const pkmcal_real CIRCLE_RADIUS = PKMCAL_NUMBER(0.01); /* m, about home */
static const int STEPS = 60;                                  /* around the circle */

static pkmcal_pose home_pose;
static pkmcal_pose last_pose; /* forward kinematics starts where it was */
static int step_number = 0;

void setup()
{
    Serial.begin(115200);
    pkmcal_home(&home_pose);
    last_pose = home_pose;
}

void loop()
{
    const pkmcal_real turn = PKMCAL_NUMBER(6.2831853) * step_number / STEPS;
    pkmcal_real joints[PKMCAL_JOINTS];
    pkmcal_pose pose = home_pose;
    pkmcal_report report;
    pkmcal_status status;
    unsigned long begin, between, end;

    pose.t[0] += CIRCLE_RADIUS * cos(turn);
    pose.t[1] += CIRCLE_RADIUS * sin(turn);

    begin = micros();
    status = pkmcal_inverse(&pose, joints);
    between = micros();
    if (status == PKMCAL_OK && pkmcal_out_of_range(joints) != 0) {
        Serial.print("joint out of range: ");
        Serial.println(pkmcal_out_of_range(joints));
    } else if (status == PKMCAL_OK) {
        /* here the motors would be told; here is where their readings say that the platform is */
        status = pkmcal_forward(joints, &last_pose, &report);
    }
    end = micros();
    if (status != PKMCAL_OK) {
        Serial.println(pkmcal_status_text(status));
    }
    for (int k = 0; k < PKMCAL_JOINTS; ++k) {
        Serial.print((double)joints[k], 6);
        Serial.print(' ');
    }
    Serial.print(" x ");
    Serial.print((double)last_pose.t[0] * 1e3, 4);
    Serial.print(" mm, inverse ");
    Serial.print(between - begin);
    Serial.print(" us, forward ");
    Serial.print(end - between);
    Serial.println(" us");

    step_number = (step_number + 1) % STEPS;
    delay(100);
}
